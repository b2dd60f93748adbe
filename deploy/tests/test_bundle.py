"""Bundles, and `deploy push` with ssh, scp and sudo that work on this computer."""

import contextlib
import hashlib
import os
import shutil
import stat
import sys
from pathlib import Path

import pytest

from deploy import bundle as bundle_module
from deploy.__main__ import main
from deploy.bundle import build_edge_wheel, build_installer, gather
from deploy.installer.release import Releases, read_bundle, read_public_key
from edge_runtime.config import load_config
from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import exit_status, refusal


@pytest.fixture(scope="module")
def party(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls") / "certs"
    words = ["certs", "--out", str(folder), "--vehicle-id=hunter01", "--vehicle-id=other"]
    assert exit_status(main, words) == 0
    (folder / "edge-hunter01" / "ca.key.pem").write_text("never to leave the workstation")
    return folder


def test_the_same_inputs_give_the_same_bytes_and_others_another_version(workshop, tmp_path):
    assert build_edge_wheel() == workshop.edge_wheel.read_bytes()
    assert build_installer() == build_installer()
    (one, same), (two, _) = (workshop.make(out=tmp_path / folder) for folder in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    changed = (workshop.make(0.2), workshop.make(wheels=[workshop.edge_wheel]))
    assert len({same.version, *(manifest.version for _, manifest in changed)}) == 3


def test_it_holds_what_the_board_needs_and_nothing_else(workshop, party, tmp_path):
    config, driver = tmp_path / "c.toml", tmp_path / "my_vehicle-0.1.0-py3-none-any.whl"
    config.write_text('connect = "tls/10.0.0.1:7447"\nvehicle = "rover"\n')
    shutil.copy(workshop.host, driver)
    wheels = [workshop.edge_wheel, driver]
    path, _ = workshop.make(tls=party / "edge-hunter01", config=config, wheels=wheels)
    _, contents = read_bundle(path, read_public_key(workshop.public_key))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert contents.keys() == {
        "manifest.json", "install.pyz", "config.toml", "policy.onnx",
        "policy.onnx.sig", "policy.pub", "tls/ca.pem", "tls/cert.pem", "tls/key.pem",
        "units/phil-can.service", "units/phil-edge.service",
        "wheels/my_vehicle-0.1.0.whl", "wheels/phil_edge_runtime-0.1.0.whl",
    }  # fmt: skip
    assert b"never to leave" not in b"".join(contents.values())
    assert workshop.key.read_bytes() not in contents.values()
    (tmp_path / "board.toml").write_bytes(contents["config.toml"])
    read_back = load_config(tmp_path / "board.toml", {})
    names = ("connect", "vehicle", "policy", "tls", "is_armed_at_start")
    assert [getattr(read_back, name) for name in names] == [
        "tls/10.0.0.1:7447", "rover", "policy.onnx", "tls/", False,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "name"),
    [
        *(
            ('policy = "other.onnx"', ""),
            ("armed_at_start = true", ""),
            ("allow_unsigned = true", ""),
        ),
        *(("no toml", ""), ('connect = "tls/10.0.0.1:7447"', "")),  # without certificates
        ('[vehicle]\ndriver = "hunter"\nhunter.speed = 3', ""),
        ('[vehicle]\ndriver = "mock"\nmock.slew_per_s = -1.0', ""),
        *(('connect = "tls/10.0.0.1:7447"', name) for name in ("edge-other", "simulator-hunter01")),
    ],
)
def test_settings_and_certificates_that_do_not_hold_are_refused(
    workshop, party, tmp_path, text, name
):
    config = tmp_path / "c.toml"
    config.write_text(text)
    with pytest.raises(UserError):
        workshop.make(config=config, tls=party / name if name else None)


@pytest.mark.parametrize(
    "wrong",
    ["policy unsigned.onnx", "public-key 0.2.pub", "key keys/policy.pub", "with {unfit}",
     "config tank.toml"],
)  # fmt: skip
def test_a_mistake_is_one_line_and_nothing_is_written(workshop, capsys, wrong, monkeypatch):
    monkeypatch.chdir(workshop.folder)
    shutil.copy(workshop.inputs(0.1).policy, "unsigned.onnx")
    workshop.inputs(0.2)
    Path("tank.toml").write_text('vehicle = "tank"')
    unfit = shutil.copy(workshop.host, "host-1.0-cp38-cp38-manylinux_2_35_aarch64.whl")
    words = "bundle --target jetpack5 --policy 0.1.onnx --key keys/policy.key --public-key 0.1.pub"
    more = f"--out out --{wrong.format(unfit=unfit)}"
    refusal(capsys, *words.split(), *more.split(), package="deploy")
    assert not Path("out").exists()


@pytest.mark.parametrize("content", [None, b"changed"])
def test_a_full_folder_needs_no_network_and_another_hash_is_not_taken(
    workshop, tmp_path, monkeypatch, content
):
    lock, kept, place = (tmp_path / name for name in ("lock.txt", "here", "place"))
    kept.mkdir()
    shutil.copy(workshop.host, kept)
    digest = hashlib.sha256(content or workshop.host.read_bytes()).hexdigest()
    lock.write_text(f"# a lock\n\nhost==1.0 --hash=sha256:{digest}\n")
    monkeypatch.setattr(bundle_module, "KEPT_WHEELS", tmp_path)
    monkeypatch.setattr(bundle_module, "lock_path", lambda target: lock)
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("PIP_RETRIES", "0")
    with pytest.raises(UserError) if content else contextlib.nullcontext():
        gather("here", str(place))
    assert [path.name for path in place.glob("*")] == ([] if content else [workshop.host.name])


PROGRAMS = {
    "ssh": 'for last; do :; done; cd "$FAR" && exec sh -c "$last"',
    "scp": """while [ "$1" != -- ]; do shift; done; shift; for last; do :; done
        for path; do [ "$path" = "$last" ] || cp "$path" "$FAR/${last#*:}"; done""",
    "sudo": f'shift 2; exec {sys.executable} "$@" --root "$FAR/opt"',
}


def test_a_push_installs_a_bundle_of_any_name(workshop, tmp_path, monkeypatch, capfd):
    """The far computer's home is a folder here."""
    (made, manifest), bundle = workshop.make(), tmp_path / "two words;id.tar"
    home = tmp_path / "far"
    for name, text in PROGRAMS.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("FAR", str(home))
    Path(f"{bundle}.sig").write_bytes(Path(f"{made}.sig").read_bytes())
    words = ["push", "phil@board", str(bundle), "--trust", str(workshop.public_key)]
    bundle.write_bytes(made.read_bytes() + b"x")
    assert exit_status(main, words) == 2  # The board would refuse it.
    bundle.write_bytes(made.read_bytes())
    capfd.readouterr()
    assert main([*words, "--dry-run"]) == 0
    printed = capfd.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == ["ssh", "scp", "ssh"]
    assert main(words) != 0  # There is no such computer yet.
    home.mkdir()
    assert main(words) == 0
    assert [path.name for path in home.iterdir()] == ["opt"]  # The bundle may hold a private key.
    assert Releases(str(home / "opt")).linked("current") == manifest.version
