"""What goes into a bundle, that it is the same again, its wheels, and which bundle is believed."""

import contextlib
import io
import os
import random
import shutil
import stat
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from unittest.mock import Mock

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy import bundle as bundle_module
from deploy.__main__ import main
from deploy.bundle import (
    DEFAULT_FOLDER,
    ROOT,
    TARGETS,
    Inputs,
    Pin,
    _drivers_in,
    _pack,
    _sign,
    build_edge_wheel,
    build_installer,
    check_wheels,
    gather,
    lock_path,
    make_bundle,
    pip,
    read_lock,
)
from deploy.installer import verify
from deploy.installer.__main__ import trusted_key
from deploy.installer.layout import Layout, unpack_wheel
from deploy.tests.boards import HERE
from edge_runtime.config import load_config
from edge_runtime.util import UserError
from hil_tests.testing.commands import exit_status
from hil_tests.testing.policies import public_pem

MAX_JETPACK5_BYTES = 45_000_000


@pytest.fixture(scope="module")
def party(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls") / "certs"
    words = ["certs", "--out", str(folder), "--vehicle-id=hunter01", "--vehicle-id=other"]
    assert exit_status(main, words) == 0
    (folder / "edge-hunter01" / "ca.key.pem").write_text("never to leave the workstation")
    return folder


def read(made) -> dict[str, bytes]:
    with tarfile.open(made.path) as tar:
        return {m.name: tar.extractfile(m).read() for m in tar}  # type: ignore[union-attr]


def test_the_same_inputs_give_the_same_bytes(workshop, tmp_path):
    again = build_edge_wheel(tmp_path)
    assert again.read_bytes() == workshop.edge_wheel.read_bytes()
    inputs, made = workshop.inputs(), []
    for number, each in enumerate((inputs, inputs._replace(wheels=[again, workshop.host]))):
        folder = make_bundle(each, HERE, tmp_path / str(number)).path.parent
        made.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert (made[0], len(made[0])) == (made[1], 2)  # the bundle and its signature
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


NO_FIT = "does not fit Python 3.8 on aarch64 with glibc 2.31"


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("driver-1.0-py3-none-any.whl", ""),
        ("driver-1.0-cp38-cp38-manylinux_2_17_aarch64.manylinux2014_aarch64.whl", ""),
        ("driver-1.0-cp38-cp38-linux_aarch64.whl", ""),
        ("driver-1.0-cp38-none-any.whl", ""),
        ("driver-1.0-cp38-cp38-manylinux_2_30_aarch64.whl", ""),
        ("driver-1.0-cp37-abi3-manylinux_2_28_aarch64.whl", ""),
        ("driver-1.0-cp311-cp311-manylinux_2_17_aarch64.whl", NO_FIT),
        ("driver-1.0-cp38-cp38-manylinux_2_17_x86_64.whl", NO_FIT),
        ("driver-1.0-cp38-cp38-manylinux_2_35_aarch64.whl", NO_FIT),
        ("NumPy-9.0-py3-none-any.whl", "has a numpy of its own"),
        ("phil_edge_runtime-9.0-py3-none-any.whl", "has a phil-edge-runtime of its own"),
        ("driver.whl", "Invalid wheel filename"),
    ],
)
def test_a_wheel_that_the_board_cannot_run_or_has_is_refused(name, match):
    expected = pytest.raises(UserError, match=match) if match else contextlib.nullcontext()
    with expected:
        check_wheels([Path("made") / name], TARGETS["jetpack5"])


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
    names = ("connect", "vehicle", "policy", "tls", "hold", "armed_at_start")
    assert [getattr(read_back, name) for name in names] == [
        "tls/10.0.0.1:7447", "mock", "policy.onnx", "tls", "../../state/hold", False,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('policy = "other.onnx"', "the bundle sets policy"),
        ('hold = "x"', "the bundle sets hold"),
        ("allow_unsigned = true", "the bundle sets allow_unsigned"),
        ('vehicle = "mock"\narmed_at_start = true', "armed_at_start would let a machine move"),
        ('connect = "tls/10.0.0.1:7447"', "needs certificates"),
        ('vehicle = "tank"', "in no wheel of the bundle: .*--with, or choose from none, mock, hu"),
        ('vehicle = "carts:Cart"', "'carts:Cart' is in no wheel"),
        ('[vehicle]\ndriver = "hunter"\nhunter.speed = 3', "vehicle.hunter: .*unknown field"),
        ('[vehicle]\ndriver = "hunter"\nhunter.bus = "can0"', "bus 'can0'"),
        ('[vehicle]\ndriver = "mock"\nmock.slew_per_s = -1.0', "slew_per_s -1.0"),
        ("no toml", "is no TOML"),
        ("\udcff", "is no TOML"),
    ],
)
def test_settings_that_do_not_hold_are_refused(workshop, tmp_path, text, match):
    config = tmp_path / "c.toml"
    config.write_bytes(os.fsencode(text))
    with pytest.raises(UserError, match=match):
        workshop.make(config=config)


def test_a_drivers_wheel_is_packed_summed_and_installed_with_the_rest(
    workshop, board, tmp_path, monkeypatch
):
    words = ("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path))
    built = ("build", "*.egg-info")  # What pip left there would be packed, too.
    source, ignored = tmp_path / "my_vehicle", shutil.ignore_patterns(*built)
    shutil.copytree(ROOT / "examples/my_vehicle", source, ignore=ignored)
    pip(*words, str(source))
    (wheel,) = tmp_path.glob("*.whl")
    config = tmp_path / "c.toml"
    inputs = [workshop.edge_wheel, workshop.host, wheel]
    for vehicle in ("rover", "my_vehicle:Rover"):
        config.write_text(f'connect = "{workshop.endpoint}"\nvehicle = "{vehicle}"\n')
        made = workshop.make(wheels=inputs, config=config)
        assert read(made)["wheels/my_vehicle-0.1.0.whl"] == wheel.read_bytes()
    assert board.install(made.path).returncode == 0
    site = Layout(str(board.root)).release(made.manifest.version) / "site-packages"
    assert (site / "my_vehicle.py").exists()
    launcher = site.parent / "bin/phil-edge"
    start = (launcher, "run", "--policy", "absent.onnx", "--vehicle")
    absent = "absent.onnx does not exist"
    for name, said in (("rover", absent), (vehicle, absent), ("tank", "rover, or a module")):
        ended = subprocess.run([*start, name], capture_output=True, text=True)
        assert (ended.returncode, said in ended.stderr) == (2, True), ended.stderr
    for vehicle in ("my_vehicle", "rover:Rover"):  # A module is no name, nor a name a module.
        config.write_text(f'vehicle = "{vehicle}"\n')
        with pytest.raises(UserError, match="in no wheel"):
            workshop.make(wheels=inputs, config=config)
    text = f'connect = "{workshop.endpoint}"\n[vehicle]\ndriver = "rover"\nrover.adress = "a:1"\n'
    config.write_text(text)
    workshop.make(wheels=inputs, config=config)  # not installed here, so nobody can tell
    with monkeypatch.context() as patch:
        patch.syspath_prepend(str(wheel))
        with pytest.raises(UserError, match="'adress'; known are address"):
            workshop.make(wheels=inputs, config=config)
        config.write_text(text.replace("adress", "address"))
        workshop.make(wheels=inputs, config=config)
    sys.modules.pop("my_vehicle", None)
    with pytest.raises(UserError, match="the bundle has another my_vehicle"):
        workshop.make(wheels=[*inputs, wheel])


def test_a_drivers_name_keeps_its_capital_letters(tmp_path):
    path = tmp_path / "rover-1-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as made:
        made.writestr("rover-1.dist-info/entry_points.txt", "[phil.vehicles]\nMyRover=rover:Rover")
    assert "MyRover" in _drivers_in(path)


def test_a_bundle_of_somebody_elses_policy_or_key_or_a_long_name_is_refused(workshop, tmp_path):
    other, unsigned = workshop.inputs(0.2), tmp_path / "unsigned.onnx"
    unsigned.write_bytes(other.policy.read_bytes())
    long = tmp_path / f"{'a' * 190}-1-py3-none-any.whl"
    long.write_bytes(workshop.host.read_bytes())
    for changes, match in (
        ({"public_key": other.public_key}, "does not fit the policy file and public key"),
        ({"policy": unsigned}, r"is not signed(?!.*--allow-unsigned)"),  # no bundle has it
        ({"key": tmp_path / "missing.key"}, "not exist"),
        ({"wheels": [tmp_path / "missing.whl"]}, "missing.whl cannot be read"),
        ({"wheels": [unsigned]}, "unsigned.onnx cannot be read: File is not a zip file"),
        ({"key": workshop.public_key}, "private"),
        ({"wheels": [workshop.edge_wheel, long]}, "too long for a bundle"),
    ):
        with pytest.raises(UserError, match=match):
            workshop.make(0.1, **changes)


@pytest.mark.parametrize("name", ["edge-other", "simulator-hunter01", "ca"])
def test_the_certificates_must_be_this_vehicles(workshop, party, tmp_path, name):
    (tmp_path / "c.toml").write_text('connect = "tls/10.0.0.1:7447"\n')
    with pytest.raises(UserError):
        workshop.make(tls=party / name, config=tmp_path / "c.toml")


@pytest.mark.parametrize(
    "arguments",
    ["", "--target toaster", *(f"--target jetpack5 {wrong}" for wrong in (
        "--policy missing.onnx", "--key missing.key", "--tls nowhere",
        "--wheels /dev/null/wheels", "--out /dev/null/bundles", "--with {edge_wheel}",
    ))],
)  # fmt: skip
def test_a_mistake_is_said_before_any_download(workshop, tmp_path, capsys, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    if "--wheels" not in arguments:
        monkeypatch.setattr(bundle_module, "gather", lambda *_: pytest.fail("downloads"))
    inputs = workshop.inputs()
    good = ["--policy", inputs.policy, "--public-key", inputs.public_key, "--key", inputs.key]
    words = arguments.format(edge_wheel=workshop.edge_wheel).split()
    status = exit_status(main, ["bundle", *map(str, good), *words])
    said = capsys.readouterr().err.strip().splitlines()
    assert (status, len(said)) == (2, 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("place", "name", "error"),
    [
        (bundle_module, "write_private", UserError("full")),
        (os, "replace", KeyboardInterrupt("now")),
    ],
)
def test_a_bundle_that_is_not_finished_leaves_no_signature_and_no_key(
    workshop, tmp_path, monkeypatch, place, name, error
):
    monkeypatch.setattr(place, name, Mock(side_effect=error))
    with pytest.raises(type(error), match=str(error)):
        make_bundle(workshop.inputs(), HERE, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def wheel(*members: str) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name in members:
            archive.writestr(name, name)
    return packed.getvalue()


def test_packages_come_out_scripts_stay_in_and_no_two_wheels_hold_the_same_file(tmp_path):
    data = wheel(
        "a/__init__.py", "a-1.dist-info/RECORD", "a-1.data/purelib/b.py", "a-1.data/platlib/c/d.so",
        "a-1.data/scripts/tool", "a-1.data/headers/a.h", "a-1.data/data/share/x",
    )  # fmt: skip
    unpack_wheel(data, "a-1.whl", tmp_path)
    found = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {"a/__init__.py", "a-1.dist-info/RECORD", "b.py", "c/d.so"}
    for clash in ("b.py", "b.py/x.py", "b-1.data/purelib/b.py"):
        with pytest.raises(verify.UserError, match="another wheel"):
            unpack_wheel(wheel(clash), "b-1.whl", tmp_path)


def damaged() -> bytes:
    """A wheel whose compressed member does not unpack."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.py", "".join(map(str, range(999))))
    return packed.getvalue().replace(packed.getvalue()[60:70], bytes(10))


LEAVES = ("../x.py", "/x.py", "a/../../x.py", "a\\..\\x.py", "a-1.data/purelib/../../x.py")


@pytest.mark.parametrize(
    ("data", "match"),
    [
        *((wheel(name), "outside") for name in LEAVES),
        *((data, "is not a wheel") for data in (b"", b"no zip", wheel("a.py")[:-30], damaged())),
    ],
    # A wheel holds the time at which it is made, and every worker must collect the same names.
    ids=[*LEAVES, "empty", "no zip", "cut short", "damaged"],
)
def test_what_is_no_wheel_or_leaves_the_folder_is_refused(tmp_path, data, match):
    with pytest.raises(verify.UserError, match=match):
        unpack_wheel(data, "a-1.whl", tmp_path / "site")
    assert not (tmp_path / "x.py").exists()


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_every_target_is_locked_by_hash_and_the_twin_has_the_boards_versions(target):
    pins = read_lock(lock_path(target))
    names = {pin.name for pin in pins}
    assert {"numpy", "onnxruntime", "eclipse-zenoh", "msgspec", "cryptography", "tomli"} <= names
    assert len(names) == len(pins)
    if target.name == "jetpack5":
        twin = read_lock(lock_path(TARGETS["linux-x86_64"]))
        assert [pin[:2] for pin in pins] == [pin[:2] for pin in twin]


@pytest.mark.parametrize("line", ["numpy", "numpy>=1", "numpy==1.0", "numpy==1 --hash=sha256:ab"])
def test_a_lock_without_version_or_hash_is_refused(tmp_path, line):
    path = tmp_path / "lock.txt"
    path.write_text(f"# a lock\n\n{line}\n")
    with pytest.raises(UserError, match=r"lock\.txt: not NAME==VERSION"):
        read_lock(path)


def test_a_full_folder_needs_no_network(tmp_path, monkeypatch):
    monkeypatch.setattr(bundle_module, "pip", lambda *_: pytest.fail("pip was asked"))
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


FILES = {"config.toml": b"a = 1\n", "empty": b"", "wheels/a-1.whl": bytes(range(256)) * 5}
KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))
MADE = verify.Manifest("0.1.0-a-b", HERE, "hunter01", "p" * 64)
CONTENTS = {**FILES, verify.MANIFEST: verify.to_json(MADE)}


PUBLIC = public_pem(KEY)


@pytest.fixture
def bundle(tmp_path):
    path = tmp_path / "bundle.tar"
    write(path, _pack(CONTENTS))
    return path


def write(path, data: bytes, key: Ed25519PrivateKey = KEY) -> None:
    path.write_bytes(data)
    path.with_name(f"{path.name}.sig").write_bytes(_sign(data, key))


def refused(path, match: str = "is refused", key: bytes = PUBLIC) -> None:
    with pytest.raises(verify.UserError, match=match):
        verify.read_bundle(str(path), key)


def test_what_was_put_in_comes_out_and_others_read_it_too(bundle, tmp_path):
    opened = verify.read_bundle(str(bundle), PUBLIC)
    assert (opened.manifest, opened.files) == (MADE, CONTENTS)
    subprocess.run(["tar", "--extract", "--file", bundle], cwd=tmp_path, check=True)
    assert all((tmp_path / name).read_bytes() == data for name, data in CONTENTS.items())


def changed(path):
    """30 seeded places of a file, one byte of it changed at a time."""
    whole, choice = path.read_bytes(), random.Random(7)
    for place in choice.sample(range(len(whole)), 30):
        data = bytearray(whole)
        data[place] ^= choice.randrange(1, 256)
        path.write_bytes(data)
        yield
    path.write_bytes(whole)


def test_any_one_byte_changed_is_found(bundle):
    for _ in changed(bundle):
        refused(bundle, "is refused: its signature is not of the key")
    # A signature is text: a few changes, as of a line's end, leave what it says as it was.
    taken = 0
    for _ in changed(bundle.with_name("bundle.tar.sig")):
        with contextlib.suppress(verify.UserError):
            assert verify.read_bundle(str(bundle), PUBLIC).files == CONTENTS
            taken += 1
    assert taken < 3


def test_another_key_a_signature_for_something_else_and_none_are_refused(bundle, monkeypatch):
    data = bundle.read_bytes()
    write(bundle, data, Ed25519PrivateKey.generate())
    refused(bundle, "signature is not of the key")
    monkeypatch.setattr(bundle_module, "NAMESPACE", "file")
    write(bundle, data)
    refused(bundle, "signature is not of the key")
    bundle.with_name("bundle.tar.sig").unlink()
    refused(bundle, r"signature .*bundle\.tar\.sig does not exist")


def tar_of(*kinds: bytes) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        for kind in kinds:
            member = tarfile.TarInfo("a")
            member.type, member.linkname = kind, "config.toml"
            tar.addfile(member)
    return packed.getvalue()


NAMES = ("/etc/passwd", "../x", "a/../../x", "a//b", "", ".hidden", "a/.", "a\nb", "a b")
KINDS = (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE)
STRANGE = {
    **{f"name {name!r}": _pack({**CONTENTS, name: b"x"}) for name in NAMES},
    **{f"kind {kind!r}": tar_of(kind) for kind in KINDS},
    "file twice": tar_of(tarfile.REGTYPE, tarfile.REGTYPE),
}
NO_BUNDLE = {"empty": b"", "no tar": b"no tar", "no manifest": _pack(FILES)}


@pytest.mark.parametrize("what", [*STRANGE, *NO_BUNDLE])
def test_what_is_signed_and_no_bundle_is_refused(bundle, what):
    write(bundle, {**STRANGE, **NO_BUNDLE}[what])
    refused(bundle, "holds what no bundle may hold" if what in STRANGE else "is refused")


BAD_VERSIONS = [verify.to_json(MADE._replace(version=version)) for version in ("../x", "")]


@pytest.mark.parametrize(
    ("raw", "match"),
    [
        *((raw, "manifest is not valid") for raw in (b"", b"[]", b"{}", *BAD_VERSIONS)),
        (verify.to_json(MADE).replace(b'"format":1', b'"format":2'), "format is 2"),
    ],
)
def test_a_signed_manifest_that_makes_no_sense_is_refused(raw, match):
    with pytest.raises(verify.UserError, match=match):
        verify.parse_manifest(raw)


@pytest.mark.parametrize("name", ["missing.tar", ".", "pipe", "/dev/zero"])
def test_what_cannot_be_read_is_one_line(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(verify.UserError, match=r"does not exist|is a directory|is no regular file"):
        trusted_key(Layout(str(tmp_path)), str(tmp_path / name))
    refused(tmp_path / name, r"does not exist|is a directory|is no regular file")


def test_an_ssh_keygen_that_cannot_verify_is_said(bundle, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    refused(bundle, "ssh-keygen cannot be run")
    (tmp_path / "ssh-keygen").write_text("#!/bin/sh\necho unknown option -- Y >&2; exit 1\n")
    (tmp_path / "ssh-keygen").chmod(0o755)
    refused(bundle, "OpenSSH 8.2")


def test_a_key_is_the_same_however_its_lines_end_and_what_is_none_is_said(tmp_path):
    path, pem = tmp_path / "key.pub", public_pem(ec.generate_private_key(ec.SECP256R1()))
    path.write_bytes(PUBLIC.replace(b"\n", b"\r\n"))
    assert verify.ssh_key(verify.read_public_key(str(path))) == verify.ssh_key(PUBLIC)
    assert verify.ssh_key(PUBLIC) != verify.ssh_key(public_pem(Ed25519PrivateKey.generate()))
    for wrong in (b"", b"\xff\xfe", pem, pem[:-30], pem.replace(b"PUBLIC", b"PRIVATE")):
        path.write_bytes(wrong)
        with pytest.raises(verify.UserError, match="public key is not"):
            verify.read_public_key(str(path))
