"""One verdict over a policy: its rows, its three files, and that it goes on where it was ended."""

import os
import re
import sys
import xml.etree.ElementTree as ET
from argparse import Namespace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from bridge.network import parse_spec
from bridge.outcomes import success_estimate
from edge_runtime.config import Config
from edge_runtime.policy import load_policy
from edge_runtime.vehicles.mock import MockVehicle
from hil_tests.__main__ import main
from hil_tests.accept import checks, command, page
from hil_tests.accept.checks import Check, Found
from hil_tests.envelope import UntoldError
from hil_tests.processes import POLICY, PUBLIC_KEY
from hil_tests.tests.shared.commands import exit_status, refusal
from hil_tests.tests.shared.drives import LEFT_TURN, read
from hil_tests.tests.shared.policies import public_pem, write_policy
from trainer.util import claimed

SHIPPED = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY), "--env", "left_turn")


@pytest.fixture(autouse=True)
def _in_the_root(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])


@pytest.fixture
def signed(tmp_path):
    """Make signed policies; return the options that name one."""
    key = Ed25519PrivateKey.generate()
    (tmp_path / "policy.pub").write_bytes(public_pem(key))

    def make(name, kind="constant", value=0.3):
        write_policy(tmp_path / name, kind, value, key=key)
        trust = ("--public-key", str(tmp_path / "policy.pub"))
        return ("--policy", str(tmp_path / name), *trust, "--env", "left_turn")

    return make


def accept(out, *words):
    """Run the command; return its exit status, its report, and the names that failed."""
    status = exit_status(main, ["accept", "--out", str(out), *map(str, words)])
    report = read(out / "report.json")
    return status, report, [c["name"] for c in report["checks"] if c["result"] == "failed"]


def test_an_unsigned_file_is_rejected_and_not_driven(tmp_path, capsys):
    bare = tmp_path / "bare.onnx"
    bare.write_bytes(POLICY.read_bytes())
    out = tmp_path / "out"
    words = ("--policy", bare, "--public-key", PUBLIC_KEY, "--env", "left_turn")
    status, report, failed = accept(out, *words)
    assert (status, report["verdict"], failed) == (1, "rejected", ["signature and manifest"])
    assert report["policy_id"] == load_policy(POLICY, PUBLIC_KEY).policy_id
    assert "not signed" in report["checks"][0]["why"]
    assert {each["result"] for each in report["checks"][1:]} == {"not_tried"}
    assert " 0.0 min left" in capsys.readouterr().out  # Nothing else is to come.
    assert {*report["checks"][0]} == {"name", "asked", "measured", "result", "why"}
    suite = ET.parse(out / "junit.xml").getroot()
    assert suite.get("tests") == str(len(report["checks"])) == str(len(suite.findall("testcase")))
    assert [len(suite.findall(f"testcase/{kind}")) for kind in ("failure", "skipped")] == [
        1,
        len(report["checks"]) - 1,
    ]
    assert sorted(os.listdir(out)) == ["junit.xml", "report.html", "report.json"]


def test_a_policy_slower_than_asked_is_rejected_and_not_driven(tmp_path, signed):
    settings = tmp_path / "accept.toml"
    settings.write_text("inference_share = 1e-6\n")
    status, report, failed = accept(tmp_path / "out", *signed("p.onnx"), "--config", settings)
    assert (status, failed) == (1, ["inference time"])
    assert "p99" in report["checks"][1]["measured"]
    assert {each["result"] for each in report["checks"][2:]} == {"not_tried"}


@pytest.mark.parametrize("fails", ["", "-m edge_runtime nonsense", "-c print({})", "-c 1"])
@pytest.mark.parametrize("board", ["phil@xavier", "", "-oProxyCommand=touch pwned"])
def test_the_board_measures_the_inference_time_by_ssh(tmp_path, monkeypatch, signed, board, fails):
    """The stand-in for ssh runs the command here, in place of on the board."""
    tools = {
        "ssh": f'echo "$@" > {tmp_path}/asked; for last; do :; done; cd {tmp_path}; sh -c "$last"',
        "phil-edge": f'exec {sys.executable} {fails or "-m edge_runtime"} "$@"',
    }
    for name, text in tools.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.getcwd())
    words = signed("p.onnx")
    asked = Namespace(policy=words[1], board=board)
    policy = load_policy(*words[1:4:2])
    ask = SimpleNamespace(board_command=str(tmp_path / "phil-edge"), inference_share=1.0)
    job: Any = SimpleNamespace(asked=asked, policy=policy, settings=ask, period_s=0.1, trust=[])
    if fails:
        with pytest.raises(checks.UserError):
            checks.inference(job)
        return
    found = checks.inference(job)
    assert not found.wrong
    assert board in found.measured
    words_of_ssh = (tmp_path / "asked").read_text()
    assert "BatchMode=yes" in words_of_ssh
    assert f" -- {board} " in words_of_ssh


def planted(monkeypatch, *rows):
    monkeypatch.setattr(command, "table", lambda job: list(rows))


def untold(_):
    raise UntoldError("nobody says how it ended")


def test_after_an_interrupt_the_same_command_goes_on(tmp_path, monkeypatch, capsys):
    done, out = [], tmp_path / "out"

    def run(name, found, _):
        done.append(name)
        if done == ["a", "b"]:
            raise KeyboardInterrupt
        return found

    rows = [Check(name, "asked", 1.0, partial(run, name, Found("well"))) for name in "abc"]
    rows.append(Check("d", "asked", 1.0, untold))
    planted(monkeypatch, *rows)
    assert exit_status(main, ["accept", "--out", str(out), *SHIPPED]) == 130
    assert not (out / "report.json").exists()
    assert "min left" in capsys.readouterr().out
    status, report, _ = accept(out, *SHIPPED)
    assert (status, report["verdict"], done) == (0, "passed", [*"abbc"])
    assert [each["result"] for each in report["checks"]] == ["passed"] * 3 + ["not_tried"]
    # A finished one begins anew, and so does one with other settings.
    assert accept(out, *SHIPPED)[0] == 0
    assert done == [*"abbcabc"]


def test_other_settings_begin_anew(tmp_path, monkeypatch):
    done = []

    def run(name, _):
        done.append(name)
        if done[1:] == ["b"]:
            raise KeyboardInterrupt
        return Found("well")

    planted(monkeypatch, *(Check(name, "", 1.0, partial(run, name)) for name in "ab"))
    assert exit_status(main, ["accept", "--out", str(tmp_path), *SHIPPED]) == 130
    assert accept(tmp_path, *SHIPPED, "--quick")[0] == 0
    assert done == [*"abab"]


def test_hostile_words_are_text_in_all_three_files(tmp_path, monkeypatch):
    words = "<script>\x07\x1b[2J\udcff&'\""
    ends = ((words, ""), (words, words))
    rows = [Check(words, words, 1.0, partial(lambda end, _: Found(*end), end)) for end in ends]
    planted(monkeypatch, *rows, Check("c", "", 1.0, untold, words))
    monkeypatch.setattr(sys, "argv", ["accept", words])
    status, report, failed = accept(tmp_path, *SHIPPED)
    assert (status, len(failed)) == (1, 1)
    cases = ET.parse(tmp_path / "junit.xml").getroot().findall("testcase")
    assert [each.get("name") for each in cases] == [each["name"] for each in report["checks"]]
    html = (tmp_path / "report.html").read_text()
    assert "<script" not in html
    assert not {"\x07", "\x1b"} & {*html}


def test_two_at_once_do_not_write_into_one_folder(tmp_path, capsys):
    with claimed(tmp_path):
        assert refusal(capsys, "accept", "--out", tmp_path, *SHIPPED, package="hil_tests")
    assert not os.listdir(tmp_path)


class Planted:
    """Drives that hold up to a limit of the mean delay both ways, in ms."""

    def __init__(self, limit_ms):
        self.limit_ms, self.drivers = limit_ms, lambda: self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def share(self, _, link):
        assert link.up.delay_ms >= 0.0
        held = (link.up.delay_ms + link.down.delay_ms) / 2 <= self.limit_ms
        return success_estimate(200 if held else 150, 200)


@pytest.mark.parametrize(
    ("link", "limit_ms", "quick", "passes", "bears"),
    [
        ("50ms+-10ms,loss=1%", 310, False, True, 300),
        ("up.delay=100ms", 310, False, True, 300),
        ("none", 310, True, True, 50),
        ("400ms", 310, False, False, 300),
        ("280ms", 310, False, False, 305),
        ("280ms", -1, False, False, None),
    ],
)
def test_the_limit_is_found_from_the_declared_link(link, limit_ms, quick, passes, bears):
    job: Any = Planted(limit_ms)
    job.asked = Namespace(link=parse_spec(link), quick=quick)
    job.settings = SimpleNamespace(success_link=0.9, margin_delay_ms=50.0)
    found = checks.distance("delay", job)
    assert bool(found.wrong) != passes
    assert found.data
    limit = found.data["limit"]
    assert limit == bears or abs(limit - bears) <= 25.0
    assert limit is None or limit <= limit_ms
    declared = checks.mean_of(job.asked.link, "delay_ms")
    assert {0.0, declared, declared + 50.0} <= {*found.data["points"]}


def test_a_recording_that_another_policy_made_fails(signed):
    words = signed("p.onnx", "constant", 0.3)
    policy = load_policy(*words[1:4:2])
    job: Any = SimpleNamespace(
        policy=policy, policy_id=policy.policy_id, config=Config(policy=words[1])
    )
    found = checks.replay(LEFT_TURN, job)
    assert load_policy(POLICY, PUBLIC_KEY).policy_id[:12] in found.wrong


@pytest.mark.parametrize(
    ("reports", "is_good", "calls"),
    [
        ([{}], True, 1),
        ([{"wrong": ["safe stop: no_fresh_state"]}, {}], True, 2),
        ([{"reaction_late": 1}, {"recovery_late": 1}], False, 2),
        ([{"wrong": ["x"], "unsafe": ["action 2.0"]}], False, 1),
        ([{"crashes": ["edge_runtime run"]}], False, 1),
    ],
)
def test_a_fault_is_missed_twice_or_dangerous_before_it_fails(monkeypatch, reports, is_good, calls):
    whole: dict[str, Any] = {"reaction_late": 0, "recovery_late": 0, "reaction_limit_ms": 250.0}
    whole |= {"wrong": [], "unsafe": [], "crashes": [], "recovery_limit_ms": None}
    whole |= {"reaction_ms": {"max": 210.0}, "recovery_ms": {}}
    left = [{**whole, **report} for report in reports]
    monkeypatch.setattr(checks, "run_faults", lambda *_, **__: {"rows": [left.pop(0)]})
    asked = Namespace(policy="p.onnx", public_key=None)
    job: Any = SimpleNamespace(asked=asked, settings=SimpleNamespace(tries=1))
    found = checks.fault(checks.ROWS[0], job)
    assert (not found.wrong, len(reports) - len(left)) == (is_good, calls)
    assert ("at first" in found.measured) == (calls == 2)


def test_the_page_needs_nothing_else_and_shows_the_failed_drives_first(tmp_path):
    share = success_estimate(9, 10)
    link = {"points": {"0.0": share, "50.0": share}, "declared": 50.0, "limit": None, "least": 0.9}
    drive = {
        "outcomes": ["goal", "goal", "collision", "goal"],
        "edge_ms": [1.0, 2.0],
        "period_ms": 100.0,
    }
    (tmp_path / checks.DRIVE_FILE).write_bytes(LEFT_TURN.read_bytes())
    row = dict.fromkeys(("asked", "measured", "why"), "<b>")
    report = {
        "verdict": "rejected", "policy_id": "p", "policy": "/p.onnx", "env": "e", "vehicle": "none",
        "link": "none", "board": None, "quick": False, "created": "", "seconds": 61.0,
        "command": "python", "checks": [{**row, "name": name, "result": name.split()[-1]}
                                        for name in ("passed", "fault failed", "failed")],
        "data": {checks.DRIVE: drive, "link: distance to the limit of delay": link},
    }  # fmt: skip
    html = page.render(tmp_path, report)
    assert html.count("<svg") == 2
    assert html.count("<img") == 3 * page.FRAMES
    assert html.index("fault failed") < html.index("<svg") < html.rindex("passed")
    assert "<b>&" not in html
    assert "&lt;b&gt;" in html
    assert re.findall(r"<h2>(Drive .*)</h2>", html) == [
        "Drive 3: collision", "Drive 1: goal", "Drive 2: goal",
    ]  # fmt: skip
    assert not re.findall(r'(?:src|href)="(?!data:|#)', html)


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        (("--env", "congestion"), ""),
        (("--vehicle", "rovr"), ""),
        (("--link", "fast"), ""),
        (("--public-key", "nokey.pub"), ""),
        ((), "rnus = 3"),
        ((), "runs = 0"),
        ((), "success = { sunny = 0.5 }"),
        ((), "success = { nominal = nan }"),
        ((), "success_link = 93.0"),
        ((), "faults = ['edge_killed', 'edge_kiled']"),
        ((), "recordings = ['none.mcap']"),
        ((), "edge = 'none.toml'"),
        ((), "edge = 'EDGE'"),
        (("--quick",), "quick = { tries = 'many' }"),
        (("--quick",), "quick = 3"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(tmp_path, capsys, words, settings):
    (tmp_path / "edge.toml").write_text("connect = 'tls/10.0.0.1:7447'\ntls = 'certs/edge-a'\n")
    (tmp_path / "accept.toml").write_text(settings.replace("EDGE", f"{tmp_path}/edge.toml"))
    out = tmp_path / "out"
    given = ("--out", out, *SHIPPED, "--config", tmp_path / "accept.toml", *words)
    assert refusal(capsys, "accept", *given, package="hil_tests")
    assert not out.exists()


class Late(MockVehicle):
    """Its brake works 0.6 s after it was asked."""

    due = None

    def enable(self, now_s):
        self.due = None
        super().enable(now_s)

    def brake(self, now_s, latch=True):
        self.due = self.due or (now_s + 0.6, latch)

    def feedback(self, now_s):
        if self.due and now_s >= self.due[0]:
            super().brake(now_s, self.due[1])
            self.due = None
        return super().feedback(now_s)


THROTTLE, LATE = "constant full throttle", "hil_tests.tests.test_accept:Late"
FEW = "drives = 1\nquick = { runs = 60, wire_runs = 1, vehicle_drives = 1, faults = [] }\n"


@pytest.mark.board
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("words", "settings", "failed"),
    [
        (SHIPPED, "", []),
        (THROTTLE, "", ["success, nominal"]),
        ((*SHIPPED, "--link", "400ms"), "", [checks.DRIVE]),
        ((*SHIPPED, "--vehicle", LATE), "", ["driver's conformance"]),
    ],
)
def test_what_may_drive_and_what_may_not(tmp_path, signed, words, settings, failed):
    (tmp_path / "accept.toml").write_text(FEW + settings)
    words = signed("throttle.onnx", "constant", 1.0) if words == THROTTLE else words
    more = ("--quick", "--config", tmp_path / "accept.toml")
    status, _, found = accept(tmp_path / "out", *words, *more)
    assert (status, {*failed} <= {*found}) == (int(bool(failed)), True)
