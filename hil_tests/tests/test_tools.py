import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bridge import fork
from deploy.__main__ import main as deploy
from deploy.bundle import build_installer
from edge_runtime.cli import ArgumentParser
from edge_runtime.reach import free_endpoint
from hil_tests import commands
from hil_tests.__main__ import main
from hil_tests.processes import POLICY, PUBLIC_KEY, wait_until
from hil_tests.tests.shared.commands import exit_status
from hil_tests.tests.shared.drives import read, start_simulate

ROOT = Path(__file__).parents[2]


VEHICLE = "hunter01"


@pytest.mark.board
@pytest.mark.timeout(600)
def test_without_systemd_under_python38_it_installs_offline_and_drives(tmp_path):
    """The versions of the jetpack5 bundle on Python 3.8."""
    found = [*Path.home().glob(".pyenv/versions/3.8*/bin/python"), shutil.which("python3.8")]
    if os.geteuid() != 0 or found[0] is None:
        pytest.skip("it needs root and a Python 3.8, on PATH or of pyenv")
    endpoint, opt = free_endpoint().replace("tcp/", "tls/"), tmp_path / "opt"
    keys, certificates, config = tmp_path / "keys", tmp_path / "certs", tmp_path / "edge.toml"
    config.write_text(f'connect = "{endpoint}"\nvehicle_id = "{VEHICLE}"\n')
    installer = tmp_path / "install.pyz"
    installer.write_bytes(build_installer())
    for words in (
        ["keys", "--out", keys],
        ["certs", "--out", certificates, "--vehicle-id", VEHICLE],
        ["bundle", "--policy", POLICY, "--public-key", PUBLIC_KEY, "--target", "linux-x86_64",
         "--config", config, "--key", keys / "policy.key", "--out", tmp_path,
         "--tls", certificates / f"edge-{VEHICLE}"],
    ):  # fmt: skip
        assert deploy([str(word) for word in words]) == 0
    (bundle,) = tmp_path.glob("*.tar")

    def run(*words):
        line = ["unshare", "--net", found[0], "-I", installer, *words, "--root", opt]
        path = {"PATH": os.defpath}
        return subprocess.run(line, capture_output=True, text=True, check=True, env=path).stdout

    run("install", bundle, "--trust", keys / "policy.pub", "--service", "none")
    status = json.loads(run("status"))
    words = [opt / "current/bin/phil-edge", "run", "--config", "config.toml"]
    with subprocess.Popen(words, cwd=opt / "current", stderr=subprocess.DEVNULL) as runtime:
        try:
            drive = ("--clock", "realtime", "--wait-edge-s", "120", "--vehicle-id", VEHICLE,
                     "--tls", str(certificates / f"simulator-{VEHICLE}"))  # fmt: skip
            with start_simulate(endpoint, tmp_path / "r.json", "left_turn", *drive) as simulator:
                simulator.succeed(120.0)
            episode = read(tmp_path / "r.json")
        finally:
            runtime.terminate()
    run("uninstall")
    assert (status["is_whole"], status["service"]) == (True, "not run by the installer")
    assert episode["policy_id"] == status["policy_id"]
    assert episode["answered_states"] > 0
    # A busy machine's; and states that came before the runtime had seen the listener's certificate.
    assert set(episode["rejected"]) <= {"stale", "foreign_session", "certificate"}
    assert not opt.exists()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (fork, "f.mcap --at 1 --policy p.onnx --record g.mcap --out f.json"),
        (commands.campaign, "--policy p.onnx --out r.json"),
        (commands.envelope, "--policy p.onnx --out r.json"),
    ],
)
def test_paths_are_made_absolute_before_a_simulator_may_change_the_directory(command, words):
    parser = ArgumentParser()
    command.add_arguments(parser)
    found = map(str, vars(parser.parse_args(words.split())).values())
    paths = [Path(each) for each in found if Path(each).suffix in (".mcap", ".onnx", ".json")]
    assert len(paths) == words.count(".")
    assert all(path.is_absolute() for path in paths)


@pytest.mark.parametrize(
    "words",
    [
        "campaign --out {tmp}/r.json --rows lag --only latency",
        "campaign --out {tmp}/r.json --rows delay,edge_kiled",
        "campaign --out {tmp}/r.json --rows delay --only faults",
        "campaign --out {tmp}/r.json --only latency --public-key no.pub",
        *("demo --out {tmp}/file", "conformance", "conformance --vehicle tank"),
        "envelope --out {tmp}/r.json --promise 0.4",
        "mock_hunter --bus can0",
    ],
)
def test_a_mistake_is_one_line_before_anything_is_done(words, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    assert exit_status(main, words.format(tmp=tmp_path).split()) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_processes_of_a_command_that_is_killed_end(tmp_path):
    """SIGKILL leaves it no time to end them."""
    (tmp_path / "sleeper.py").write_text("import time; print('ready', flush=True); time.sleep(60)")
    starts = "from hil_tests.processes import Process; import time\n"
    starts += "print(Process('sleeper', ready='ready').pid, flush=True); time.sleep(60)"
    paths = {"PYTHONPATH": f"{ROOT}:{tmp_path}"}
    command, pipe = [sys.executable, "-c", starts], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, text=True, env=os.environ | paths) as killed:
        assert killed.stdout
        pid = int(killed.stdout.readline())
        killed.kill()
    status = Path(f"/proc/{pid}/status")  # Where nobody waits for orphans, it stays a zombie.
    wait_until(lambda: not status.exists() or "State:\tZ" in status.read_text(), "its end")
