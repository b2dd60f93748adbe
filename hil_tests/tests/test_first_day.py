"""The sheet of the first day, rehearsed as it says: TLS, a mock Hunter, and a person at both.

The board's own commands (`systemctl`, `ip`, `candump`, `journalctl`) are stand-ins, by which the
edge runtime beside us is the service.
"""

import os
import re
import shlex
import string
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from bridge.recording import Recording
from edge_runtime.link import ask
from edge_runtime.reach import free_endpoint
from edge_runtime.tls import load_tls
from hil_tests.faults.rig import Chassis, free_bus
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.drives import read

ROOT = Path(__file__).parents[2]
BOARD = """#!/bin/bash
case "$(basename "$0") $*" in
    "systemctl stop phil-edge" | "systemctl disable --now phil-edge") kill $(cat edge.pid) ;;
    "systemctl kill -s SIGKILL phil-edge") kill -9 $(cat edge.pid) ;;
    "systemctl start phil-edge" | "candump can0") ;;
    "ip link set can0 up type can bitrate 500000" | "journalctl -u phil-edge") ;;
    *) exit 1 ;;
esac
"""


class Sheet:
    """The commands of the page, in an empty folder; `left` are those that nobody has typed."""

    def __init__(self, folder: Path) -> None:
        port = free_endpoint("tls").rpartition(":")[2]
        text = (ROOT / "docs/first_day.md").read_text().replace(":7447", f":{port}")
        names, self.settings, *others = re.findall("```bash\n(.*?)```", text, re.DOTALL)
        self.folder, self.bus = folder, free_bus()
        given = shlex.split(names, comments=True)[1:]
        self.names = {**dict(each.split("=", 1) for each in given), "BUS": self.bus}
        lines = "".join(others).replace("\\\n", "").splitlines()
        self.lines = [re.sub("  +#.*", "", line) for line in lines]
        self.left = set(self.lines)
        for name in ("systemctl", "ip", "candump", "journalctl"):
            (folder / name).write_text(BOARD)
            (folder / name).chmod(0o755)
        (folder / "results").symlink_to(ROOT / "results")
        path = f"{folder}:{Path(sys.executable).parent}:{os.environ['PATH']}"
        self._environment = {**os.environ, **self.names, "PATH": path}

    def line(self, begin: str) -> str:
        """Return the command that begins so, which is typed."""
        (line,) = (each for each in self.lines if each.startswith(begin))
        self.left.discard(line)
        return line

    def shell(self, line: str) -> int:
        words = ["bash", "-euc", line]
        return subprocess.call(words, cwd=self.folder, env=self._environment)

    def process(self, begin: str, **options: Any) -> Process:
        words = shlex.split(string.Template(self.line(begin)).substitute(self.names))
        assert words[:2] == ["python", "-m"]
        return Process(*words[2:], cwd=self.folder, **options)


def operate(process: Process, mock: Chassis) -> int:
    """Say yes to a jog, with one hand at the remote control and the emergency stop."""
    answered, pressed = 0, ""
    while not process.has_ended:
        lines = [line for _, line in process.lines]
        asked = [above for above, line in pairwise(lines) if "Enter: yes" in line]
        if len(asked) == answered:
            time.sleep(0.02)
            continue
        answered, question = len(asked), asked[-1]
        if "let go" in question:
            mock.switch(pressed, False)
        process.tell("")
        if "after Enter" in question:
            pressed = "remote" if "remote control" in question else "estop"
            if "wheels turn" in question:
                wait_until(lambda: mock.moves, "the wheels to turn")
            time.sleep(1.0)  # A person's reaction
            mock.switch(pressed, True)
    return process.wait()


@pytest.mark.board
@pytest.mark.timeout(600)
def test_every_command_of_the_first_day_works(tmp_path):
    sheet = Sheet(tmp_path)
    assert sheet.shell(sheet.settings) == 0
    where, operator = (
        (sheet.names["AT"], "hunter01"),
        load_tls(tmp_path / "certs/operator-hunter01"),
    )
    edge_pid = tmp_path / "edge.pid"

    def service():
        edge = sheet.process("python -m edge_runtime run", ready="ready")
        edge_pid.write_text(str(edge.pid))
        return edge

    def rearms(line):
        wait_until(lambda: sheet.shell(line) == 0, "a re-arm")

    assert sheet.line("python -m hil_tests").endswith(" mock_hunter --bus $BUS")
    with Chassis(sheet.bus) as mock:
        with sheet.process("python -m edge_runtime jog") as jogs:
            assert operate(jogs, mock) == 0, jogs.output
        found = read(tmp_path / "jog.json")
        assert found["result"] == "passed"
        assert [step["result"] for step in found["steps"]] == ["passed"] * 9

        begin_s = time.monotonic()
        with (
            service(),
            sheet.process("python -m bridge simulate") as simulate,
            sheet.process("python -m bridge record", ready="recording") as record,
        ):
            simulate.wait_for_line("waits for a re-arm (not_armed): ")
            printed = next(line for _, line in simulate.lines if "(not_armed): " in line)
            with sheet.process("python -m edge_runtime status --watch") as watch:
                watch.wait_for_line("NOBODY until a re-arm")
                watch.wait_for_line("battery")
            assert not mock.moved_between(begin_s, time.monotonic())
            rearms(printed.partition("(not_armed): ")[2])
            typed = sheet.line("python -m edge_runtime rearm")
            for fault in ("remote", "estop"):
                wait_until(lambda: mock.moves, "the wheels to turn")
                on_s = mock.switch(fault, True)
                stands_s = mock.stands_s(on_s, 5.0)
                assert sheet.shell(typed) == 2
                mock.switch(fault, False)
                time.sleep(0.5)
                assert not mock.moved_between(stands_s, time.monotonic())
                rearms(typed)
            simulate.wait_for_line("episode 1: the vehicle waits for a re-arm (episode)")
            status = ask(*where, "status", operator)
            assert status["feedback"]["battery_v"] > 0
            rearms(typed)
            assert simulate.wait() == 0, simulate.errors
            assert record.wait() == 0, record.errors
        report = read(tmp_path / "first_day.json")
        assert report["policy_ids"] == [status["policy_id"]]
        assert not report["interrupted"]
        recording = Recording(tmp_path / "first_day.mcap")
        assert (recording.damaged_places, recording.cut_off) == (0, False)
        for begin, ends in (
            ("systemctl stop", 0),
            ("systemctl kill", -9),
            ("systemctl disable", 0),
        ):
            with service() as edge:
                assert sheet.shell(sheet.line(begin)) == 0
                assert edge.wait() == ends
        for line in ("systemctl start", "journalctl"):
            assert sheet.shell(sheet.line(line)) == 0
    assert sheet.left == set()
