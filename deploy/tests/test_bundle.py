"""What goes into a bundle and what may not, that it is the same again, and its wheels."""

from __future__ import annotations

import io
import os
import stat
import tarfile
import zipfile
from pathlib import Path

import pytest

from deploy import bundle
from deploy.__main__ import main
from deploy.bundle import (
    DEFAULT_FOLDER,
    ROOT,
    TARGETS,
    Inputs,
    Pin,
    build_edge_wheel,
    build_installer,
    gather,
    lock_path,
    make_bundle,
    read_lock,
)
from deploy.installer.layout import unpack_wheel
from deploy.installer.verify import UserError as InstallerError
from deploy.tests.boards import HERE
from edge_runtime.config import load_config
from edge_runtime.tests.harness import exit_status
from edge_runtime.util import UserError

MAX_JETPACK5_BYTES = 45_000_000


@pytest.fixture(scope="module")
def party(tmp_path_factory):
    """A vehicle's TLS folder, and another vehicle's."""
    folder = tmp_path_factory.mktemp("tls") / "certs"
    assert exit_status(main, ["certs", "--out", str(folder), "--vehicle-id", "hunter01",
                          "--vehicle-id", "other"]) == 0  # fmt: skip
    (folder / "edge-hunter01" / "ca.key.pem").write_text("never to leave the workstation")
    return folder


def read(made) -> dict[str, bytes]:
    with tarfile.open(made.path) as tar:
        return {m.name: tar.extractfile(m).read() for m in tar}  # type: ignore[union-attr]


def test_the_same_inputs_give_the_same_bytes(workshop, tmp_path):
    again = build_edge_wheel(tmp_path)
    assert again.read_bytes() == workshop.edge_wheel.read_bytes()
    inputs = workshop.inputs()
    one = make_bundle(inputs, HERE, tmp_path / "one")
    two = make_bundle(inputs._replace(wheels=[again, workshop.host]), HERE, tmp_path / "two")
    assert one.path.name == two.path.name
    assert one.path.read_bytes() == two.path.read_bytes()
    signatures = [made.path.with_name(f"{made.path.name}.sig") for made in (one, two)]
    assert signatures[0].read_bytes() == signatures[1].read_bytes()
    assert build_installer() == build_installer()


@pytest.mark.board
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", TARGETS)
def test_a_whole_bundle_is_the_same_again_and_the_boards_is_small(workshop, tmp_path, name):
    """With every wheel: pip's index is needed the first time."""
    target, policy = TARGETS[name], ROOT / "results/policies/left_turn.onnx"
    try:
        wheels = gather(target, lock_path(target), ROOT / DEFAULT_FOLDER / name)
    except UserError as error:
        if "No matching distribution" in str(error):
            pytest.skip("no package index can be reached")
        raise
    wheels.append(workshop.edge_wheel)
    inputs = Inputs(policy, policy.with_name("policy.pub"), workshop.key, None, None, wheels)
    one, two = (make_bundle(inputs, target, tmp_path / folder) for folder in ("one", "two"))
    assert one.path.read_bytes() == two.path.read_bytes()
    if name == "jetpack5":
        assert one.path.stat().st_size < MAX_JETPACK5_BYTES


def test_other_bytes_are_another_version(workshop):
    versions = {workshop.make(value).manifest.version for value in (0.1, 0.2)}
    versions.add(workshop.make(0.1, wheels=[workshop.edge_wheel]).manifest.version)
    assert len(versions) == 3


def test_it_holds_what_the_board_needs_and_nothing_else(workshop, party, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text('connect = "tls/10.0.0.1:7447"\nvehicle = "mock"\n')
    made = workshop.make(tls=party / "edge-hunter01", config=config)
    contents = read(made)
    assert stat.S_IMODE(made.path.stat().st_mode) == 0o600
    assert {name for name in contents if not name.startswith("units/")} == {
        "manifest.json", "install.pyz", "config.toml", "policy.onnx",
        "policy.onnx.sig", "policy.pub", "tls/ca.pem", "tls/cert.pem", "tls/key.pem",
        "wheels/phil_edge_runtime-0.1.0.whl", "wheels/host-1.0.whl",
    }  # fmt: skip
    assert "units/phil-edge.service" in contents
    assert b"never to leave" not in b"".join(contents.values())
    assert workshop.key.read_bytes() not in contents.values()
    settings = tmp_path / "board.toml"
    settings.write_bytes(contents["config.toml"])
    read_back = load_config(settings, {})
    assert (read_back.connect, read_back.vehicle) == ("tls/10.0.0.1:7447", "mock")
    assert (read_back.policy, read_back.tls, read_back.hold) == (
        "policy.onnx", "tls", "../../state/hold",
    )  # fmt: skip
    assert not read_back.armed_at_start


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('policy = "other.onnx"', "policy is the bundle's to say"),
        ('hold = "x"', "hold is the bundle's to say"),
        ("allow_unsigned = true", "allow_unsigned is the bundle's to say"),
        ('vehicle = "mock"\narmed_at_start = true', "armed_at_start would let a machine move"),
        ('connect = "tls/10.0.0.1:7447"', "needs certificates"),
        ('vehicle = "tank"', "choose from"),
        ("no toml", "is no TOML"),
        ("\udcff", "is no TOML"),
    ],
)
def test_settings_that_do_not_hold_are_refused(workshop, tmp_path, text, match):
    config = tmp_path / "c.toml"
    config.write_bytes(os.fsencode(text))
    with pytest.raises(UserError, match=match):
        workshop.make(config=config)


def test_a_policy_of_somebody_else_or_unsigned_is_refused(workshop, tmp_path):
    other = workshop.inputs(0.2)
    with pytest.raises(UserError, match="does not fit the policy file and public key"):
        workshop.make(0.1, public_key=other.public_key)
    unsigned = tmp_path / "unsigned.onnx"
    unsigned.write_bytes(other.policy.read_bytes())
    with pytest.raises(UserError, match=r"is not signed(?!.*--allow-unsigned)"):  # no bundle has it
        workshop.make(policy=unsigned)


@pytest.mark.parametrize("name", ["edge-other", "simulator-hunter01", "ca"])
def test_the_certificates_must_be_this_vehicles(workshop, party, tmp_path, name):
    (tmp_path / "c.toml").write_text('connect = "tls/10.0.0.1:7447"\n')
    with pytest.raises(UserError):
        workshop.make(tls=party / name, config=tmp_path / "c.toml")


def test_without_a_private_key_nothing_is_signed(workshop, tmp_path):
    for key, match in ((tmp_path / "missing.key", "not exist"), (workshop.public_key, "private")):
        with pytest.raises(UserError, match=match):
            workshop.make(key=key)


@pytest.mark.parametrize(
    "arguments",
    ["", "--target toaster", *(f"--target jetpack5 {wrong}" for wrong in (
        "--policy missing.onnx", "--key missing.key", "--tls nowhere",
        "--wheels /dev/null/wheels", "--out /dev/null/bundles",
    ))],
)  # fmt: skip
def test_a_mistake_is_one_line_before_anything_is_downloaded(
    workshop, tmp_path, capsys, monkeypatch, arguments
):
    monkeypatch.chdir(tmp_path)
    if "--wheels" not in arguments:
        monkeypatch.setattr(bundle, "gather", lambda *_: pytest.fail("downloads"))
    inputs = workshop.inputs()
    good = ["--policy", inputs.policy, "--public-key", inputs.public_key, "--key", inputs.key]
    status = exit_status(main, ["bundle", *map(str, good), *arguments.split()])
    said = capsys.readouterr().err.strip().splitlines()
    assert (status, len(said)) == (2, 1)
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_no_archive_takes_is_said(workshop, tmp_path):
    long = tmp_path / f"{'a' * 190}-1-py3-none-any.whl"
    long.write_bytes(workshop.host.read_bytes())
    inputs = workshop.inputs(wheels=[workshop.edge_wheel, long])
    with pytest.raises(UserError, match="too long for a bundle"):
        make_bundle(inputs, HERE, tmp_path / "out")


def test_a_bundle_that_is_interrupted_leaves_no_key_behind(workshop, tmp_path, monkeypatch):
    def interrupted(*_) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_bundle(workshop.inputs(), HERE, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def wheel(*members: str) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name in members:
            archive.writestr(name, name)
    return packed.getvalue()


def unpacked(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_packages_come_out_and_scripts_stay_in(tmp_path):
    data = wheel(
        "a/__init__.py", "a-1.dist-info/RECORD", "a-1.data/purelib/b.py", "a-1.data/platlib/c/d.so",
        "a-1.data/scripts/tool", "a-1.data/headers/a.h", "a-1.data/data/share/x",
    )  # fmt: skip
    unpack_wheel(data, "a-1.whl", tmp_path)
    assert unpacked(tmp_path) == {"a/__init__.py", "a-1.dist-info/RECORD", "b.py", "c/d.so"}


LEAVES = ("../x.py", "/x.py", "a/../../x.py", "a\\..\\x.py", "a-1.data/purelib/../../x.py")


@pytest.mark.parametrize(
    ("data", "match"),
    [
        *((wheel(name), "outside") for name in LEAVES),
        *((data, "is not a wheel") for data in (b"", b"no zip", wheel("a.py")[:-30])),
    ],
)
def test_what_is_no_wheel_or_leaves_the_folder_is_refused(tmp_path, data, match):
    with pytest.raises(InstallerError, match=match):
        unpack_wheel(data, "a-1.whl", tmp_path / "site")
    assert not (tmp_path / "x.py").exists()


def test_two_wheels_may_not_hold_the_same_file(tmp_path):
    unpack_wheel(wheel("a.py"), "a-1.whl", tmp_path)
    for clash in ("a.py", "a.py/b.py", "b-1.data/purelib/a.py"):
        with pytest.raises(InstallerError, match="another wheel"):
            unpack_wheel(wheel(clash), "b-1.whl", tmp_path)


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_every_target_is_locked_by_hash(target):
    pins = read_lock(lock_path(target))
    names = {pin.name for pin in pins}
    assert {"numpy", "onnxruntime", "eclipse-zenoh", "msgspec", "cryptography", "tomli"} <= names
    assert len(names) == len(pins)


def test_the_twin_has_the_boards_versions():
    board, twin = (read_lock(lock_path(TARGETS[n])) for n in ("jetpack5", "linux-x86_64"))
    assert [pin[:2] for pin in board] == [pin[:2] for pin in twin]


@pytest.mark.parametrize("line", ["numpy", "numpy>=1", "numpy==1.0", "numpy==1 --hash=sha256:ab"])
def test_a_lock_without_version_or_hash_is_refused(tmp_path, line):
    path = tmp_path / "lock.txt"
    path.write_text(f"# a lock\n\n{line}\n")
    with pytest.raises(UserError, match=r"lock\.txt: not NAME==VERSION"):
        read_lock(path)


def test_a_full_folder_needs_no_network(tmp_path, monkeypatch):
    monkeypatch.setattr(bundle, "pip", lambda *_: pytest.fail("pip was asked"))
    (tmp_path / "a-1-py3-none-any.whl").write_bytes(b"")
    (tmp_path / "other-1-py3-none-any.whl").write_bytes(b"other")
    lock = tmp_path / "lock.txt"
    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    lock.write_text(f"a==1 --hash=sha256:{empty}\n")
    assert read_lock(lock) == [Pin("a", "1", empty)]
    assert gather(HERE, lock, tmp_path) == [tmp_path / "a-1-py3-none-any.whl"]


def test_a_wheel_with_another_hash_is_not_taken(tmp_path, monkeypatch):
    """The real pip: it finds no such version, or reaches no index; either is one line."""
    (tmp_path / "a-1-py3-none-any.whl").write_bytes(b"changed")
    lock = tmp_path / "lock.txt"
    lock.write_text(f"phil-edge-runtime==0.0.1 --hash=sha256:{'0' * 64}\n")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(UserError, match="pip download: ERROR: No matching distribution"):
        gather(HERE, lock, tmp_path)
