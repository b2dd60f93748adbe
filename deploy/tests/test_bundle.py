import contextlib
import hashlib
import os
import re
import shutil
import stat
from pathlib import Path
from unittest.mock import Mock

import pytest

from deploy import bundle as bundle_module
from deploy.__main__ import main
from deploy.bundle import (
    ROOT,
    TARGETS,
    build_edge_wheel,
    build_installer,
    gather,
    lock_path,
    make_bundle,
    pip,
)
from deploy.installer.verify import read_bundle
from deploy.tests.boards import HERE
from edge_runtime.config import load_config
from edge_runtime.util import UserError
from hil_tests.testing.commands import exit_status


@pytest.fixture(scope="module")
def party(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls") / "certs"
    words = ["certs", "--out", str(folder), "--vehicle-id=hunter01", "--vehicle-id=other"]
    assert exit_status(main, words) == 0
    (folder / "edge-hunter01" / "ca.key.pem").write_text("never to leave the workstation")
    return folder


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    """The wheel of the example's vehicle."""
    folder = tmp_path_factory.mktemp("driver")
    built = shutil.ignore_patterns("build", "*.egg-info")  # What pip left would be packed, too.
    source = shutil.copytree(ROOT / "examples/my_vehicle", folder / "source", ignore=built)
    pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source))
    return next(folder.glob("*.whl"))


def test_the_same_inputs_give_the_same_bytes_and_others_another_version(workshop, tmp_path):
    again = build_edge_wheel(tmp_path)
    assert again.read_bytes() == workshop.edge_wheel.read_bytes()
    assert build_installer() == build_installer()
    inputs = workshop.inputs()
    one, two = (make_bundle(inputs, HERE, tmp_path / folder) for folder in ("one", "two"))
    assert one.path.read_bytes() == two.path.read_bytes()
    changed = (workshop.make(0.2), workshop.make(wheels=[workshop.edge_wheel]))
    assert len({made.manifest.version for made in (one, two, *changed)}) == 3


def test_it_holds_what_the_board_needs_and_nothing_else(workshop, party, driver, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text('connect = "tls/10.0.0.1:7447"\nvehicle = "rover"\n')
    wheels = [workshop.edge_wheel, driver]
    made = workshop.make(tls=party / "edge-hunter01", config=config, wheels=wheels)
    _, contents = read_bundle(str(made.path), workshop.public_key.read_bytes())
    assert stat.S_IMODE(made.path.stat().st_mode) == 0o600
    assert contents.keys() == {
        "manifest.json", "install.pyz", "config.toml", "policy.onnx",
        "policy.onnx.sig", "policy.pub", "tls/ca.pem", "tls/cert.pem", "tls/key.pem",
        "units/phil-can.service", "units/phil-edge.service",
        "wheels/my_vehicle-0.1.0.whl", "wheels/phil_edge_runtime-0.1.0.whl",
    }  # fmt: skip
    assert b"never to leave" not in b"".join(contents.values())
    assert workshop.key.read_bytes() not in contents.values()
    settings = tmp_path / "board.toml"
    settings.write_bytes(contents["config.toml"])
    read_back = load_config(settings, {})
    names = ("connect", "vehicle", "policy", "tls", "hold", "armed_at_start")
    assert [getattr(read_back, name) for name in names] == [
        "tls/10.0.0.1:7447", "rover", "policy.onnx", "tls", "../../state/hold", False,
    ]  # fmt: skip


@pytest.mark.parametrize(
    "text",
    [
        *('policy = "other.onnx"', 'hold = "x"', "allow_unsigned = true", "no toml"),
        'vehicle = "mock"\narmed_at_start = true',
        'connect = "tls/10.0.0.1:7447"',  # without certificates
        'vehicle = "carts:Cart"',  # in no wheel
        '[vehicle]\ndriver = "hunter"\nhunter.bus = "can0"',
    ],
)
def test_settings_that_do_not_hold_are_refused(workshop, tmp_path, text):
    config = tmp_path / "c.toml"
    config.write_text(text)
    with pytest.raises(UserError):
        workshop.make(config=config)


@pytest.mark.parametrize("name", ["edge-other", "simulator-hunter01", "ca"])
def test_the_certificates_must_be_this_vehicles(workshop, party, tmp_path, name):
    (tmp_path / "c.toml").write_text('connect = "tls/10.0.0.1:7447"\n')
    with pytest.raises(UserError):
        workshop.make(tls=party / name, config=tmp_path / "c.toml")


@pytest.mark.parametrize(
    "wrong",
    [
        *("--wheels /dev/null/wheels", "--policy {unsigned}", "--public-key {other}"),
        *("--key {public}", "--tls nowhere", "--with {unfit}"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_written(workshop, tmp_path, capsys, wrong):
    inputs, other, out = workshop.inputs(0.1), workshop.inputs(0.2), tmp_path / "out"
    unfit = tmp_path / "host-1.0-cp38-cp38-manylinux_2_35_aarch64.whl"
    shutil.copy(workshop.host, unfit)
    unsigned = shutil.copy(inputs.policy, tmp_path / "unsigned.onnx")
    names = {"unsigned": unsigned, "unfit": unfit}
    names |= {"other": other.public_key, "public": workshop.public_key}
    words = ["bundle", "--target", "jetpack5", "--policy", inputs.policy, "--key", inputs.key]
    words += ["--public-key", inputs.public_key, "--out", out, *wrong.format(**names).split()]
    assert exit_status(main, list(map(str, words))) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not out.exists()


def test_a_bundle_that_is_not_finished_leaves_no_signature_and_no_key(
    workshop, tmp_path, monkeypatch
):
    monkeypatch.setattr(os, "replace", Mock(side_effect=KeyboardInterrupt("now")))
    with pytest.raises(KeyboardInterrupt):
        make_bundle(workshop.inputs(), HERE, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


LOCKED = re.compile(r"(?m)^([\w.-]+)==([\w.]+) --hash=sha256:[0-9a-f]{64}$")


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_every_target_is_locked_by_hash_and_the_twin_has_the_boards_versions(target):
    lock = LOCKED.findall(lock_path(target).read_text())
    names = {name for name, _ in lock}
    assert {"numpy", "onnxruntime", "eclipse-zenoh", "msgspec", "cryptography", "tomli"} <= names
    if target.name == "jetpack5":
        assert lock == LOCKED.findall(lock_path(TARGETS["linux-x86_64"]).read_text())


EMPTY = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_a_full_folder_needs_no_network_and_another_hash_is_not_taken(
    workshop, tmp_path, monkeypatch
):
    def without_network(*words: str) -> None:
        if "--no-index" not in words:
            raise UserError("no network")
        pip(*words)

    monkeypatch.setattr(bundle_module, "pip", without_network)
    lock, wheel = tmp_path / "lock.txt", workshop.edge_wheel
    for digest, holds in ((hashlib.sha256(wheel.read_bytes()).hexdigest(), True), (EMPTY, False)):
        lock.write_text(f"# a lock\n\nphil-edge-runtime==0.1.0 --hash=sha256:{digest}\n")
        with contextlib.nullcontext() if holds else pytest.raises(UserError, match="no network"):
            found = gather(HERE, lock, wheel.parent, tmp_path / digest)
    assert [path.name for path in found] == [wheel.name]


def test_a_lock_is_written_anew_with_the_hash_of_what_comes(tmp_path, monkeypatch):
    lock = tmp_path / "lock.txt"
    lock.write_text(f"# a lock\na==2 --hash=sha256:{'0' * 64}\n")
    monkeypatch.setattr(bundle_module, "lock_path", lambda target: lock)

    def pip_download(*words: str) -> None:
        assert words[-1] == "a==2"
        Path(words[words.index("--dest") + 1], "a-2-py3-none-any.whl").write_bytes(b"")

    monkeypatch.setattr(bundle_module, "pip", pip_download)
    assert main(["lock", "jetpack5"]) == 0
    assert lock.read_text() == f"# a lock\na==2 --hash=sha256:{EMPTY}\n"
