"""The command line as a user meets it, wrong inputs first."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from argparse import ArgumentTypeError
from pathlib import Path

import msgspec
import pytest
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.commands import exit_status, run_command
from hil_tests.tests.shared.messages import HEALTH, make_feedback
from hil_tests.tests.shared.policies import write_policy

import edge_runtime
from edge_runtime import __main__ as commands
from edge_runtime import cli
from edge_runtime.__main__ import main, render_status
from edge_runtime.bounds import Bounds
from edge_runtime.config import BUILT_IN, Config, convert, load_config
from edge_runtime.link import FIELDS
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import HunterSettings
from edge_runtime.vehicles.mock import MockParameters
from edge_runtime.vehicles.ros2 import Ros2Settings
from edge_runtime.watch import render


@pytest.fixture
def settings(tmp_path):
    def write(text):
        (tmp_path / "edge.toml").write_text(text)
        return tmp_path / "edge.toml"

    return write


def test_check_prints_manifest_and_latency(make_policy, tmp_path):
    signed, out = make_policy(), tmp_path / "report.json"
    result = run_command("check", *signed.flags[1:], "--out", str(out))
    assert (result.returncode, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert report == json.loads(out.read_text())
    assert report["policy_id"] == hashlib.sha256(signed.path.read_bytes()).hexdigest()
    assert report["manifest"]["task"] == "left_turn"
    assert 0 < report["inference_ms"]["p50"] <= report["inference_ms"]["max"]
    assert (report["trust"], report["public_key"]) == ("verified", str(signed.public_key))
    assert 10 < report["memory_mb"] < 500


def test_check_of_a_slow_policy_ends_soon(make_policy, monkeypatch, capsys):
    monkeypatch.setattr(commands, "_MOST_S", 0.0)
    assert exit_status(main, ["check", *make_policy().flags[1:]]) == 0
    assert json.loads(capsys.readouterr().out)["inference_runs"] == commands._FEWEST_RUNS


@pytest.fixture
def refuses(tmp_path, monkeypatch, capfd):  # capfd: what a library in C prints counts, too
    """Run a command: it must end with status 2 and one line, which holds the word."""
    monkeypatch.chdir(tmp_path)

    def run(arguments, word=""):
        status, (out, errors) = exit_status(main, arguments), capfd.readouterr()
        assert (status, out, errors.count("\n")) == (2, "", 1), errors
        assert word in errors

    return run


@pytest.mark.parametrize("command", [["check"], ["run", "--policy"]])
def test_policies_that_may_not_drive(refuses, command):
    write_policy("good.onnx")
    Path("cut.onnx").write_bytes(Path("good.onnx").read_bytes()[:-40])
    Path("foreign.onnx").write_bytes(b"\x7fELF" + bytes(100))
    refuses([*command, "absent.onnx"], "absent.onnx")
    refuses([*command, "good.onnx"], "--allow-unsigned")
    for bad in ("cut.onnx", "foreign.onnx"):
        refuses([*command, bad, "--allow-unsigned"], bad)


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("fly", "fly"),
        ("check", "POLICY.onnx"),
        ("check p.onnx --out /dev/null/place.json", "/dev/null"),
        ("run", "--policy"),
        ("run --policy p.onnx --vehicle tank", "tank"),
        ("run --policy p.onnx --bus socketcan:can0", "--vehicle hunter"),
        ("run --policy p.onnx --connect localhost", "tcp/127.0.0.1:7447"),
        ("run --policy p.onnx --vehicle-id a/b", "a/b"),
        ("run --policy p.onnx --config absent.toml", "absent.toml"),
        ("run --policy p.onnx --log-level loud", "loud"),
        ("run --policy p.onnx --tls absent", "tls/127"),
        ("run --policy p.onnx --connect tls/h:1", "--tls"),
        ("status --connect tls/h:1 --tls absent", "absent"),
        ("status --connect tcp/127.0.0.1:1", "tcp/127.0.0.1:1"),
        ("rearm --connect tcp/127.0.0.1:1", "tcp/127.0.0.1:1"),
    ],
)
def test_wrong_arguments(line, word, refuses):
    refuses(line.split(), word)


WRONG = {
    "speed = 3": "speed",
    "policy = ": "TOML",
    "log_level = 'loud'": "log_level",
    "realtime_priority = 100": "realtime_priority",
    "connect = 'localhost'": "localhost",
    "connect = 'tcp/host:70000'": "70000",
    "vehicle_id = 'a/b'": "a/b",
    "bus = 'can0'": "bus",
    "[vehicle]\nname = 'mock'": "vehicle.name",
    "[vehicle]\ndriver = 'mock'\nmax_sped_mps = 0.3": "vehicle.max_sped_mps",
    "[vehicle]\ndriver = 3": "vehicle",
    "[vehicle]\nrearm = 'never'": "vehicle.rearm.*each_episode, once",
    **{
        f"[vehicle]\n{name} = {value}": name
        for name in Bounds._fields
        for value in ("nan", "inf", "-1.0", "0", "0.0", "'fast'", "true", "[1.0]")
    },
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_config_file_is_named_with_the_key(settings, text):
    with pytest.raises(UserError, match=rf"edge\.toml.*{WRONG[text]}"):
        load_config(settings(text), {"policy": "p.onnx"})


def test_bounds_are_of_the_table_vehicle_and_a_leash_waits_for_its_re_arm(settings):
    text = "policy = 'p.onnx'\n[vehicle]\ndriver = 'mock'\nmax_speed_mps = 1\nrearm = 'once'"
    config = load_config(settings(text), {})
    assert (config.bounds, config.rearm) == (Bounds(max_speed_mps=1.0), "once")
    assert config.is_armed_at_start
    assert not load_config(settings(f"{text}\nleash_m = 2.5"), {}).is_armed_at_start


def test_flags_win_over_the_file(settings):
    path = settings("policy = 'file.onnx'\nvehicle_id = 'from_file'\nallow_unsigned = true")
    config = load_config(path, {"policy": "flag.onnx", "connect": None, "allow_unsigned": None})
    assert config == Config(policy="flag.onnx", vehicle_id="from_file", allow_unsigned=True)


def test_a_table_may_be_of_another_vehicle_and_the_flag_of_a_bus_may_not(settings):
    path = settings("policy = 'p.onnx'\nvehicle.hunter = {bus = 'socketcan:can1', model = 'se'}")
    config = load_config(path, {})
    table = {"bus": "socketcan:can1", "model": "se"}
    assert (config.vehicle, config.vehicle_settings) == ("none", {"hunter": table})
    for file in (path, None):
        flags = {"policy": "p.onnx", "bus": "socketcan:can0"}
        with pytest.raises(UserError, match="--bus"):
            load_config(file, flags)
        given = load_config(file, {**flags, "vehicle": "hunter"}).vehicle_settings["hunter"]
        assert given == {**(table if file else {}), "bus": "socketcan:can0"}


def test_the_example_config_holds_every_key_at_its_default():
    example = Path(edge_runtime.__file__).with_name("config.example.toml")
    config = load_config(example, {})
    tables = config.vehicle_settings
    assert config == Config(policy="my.onnx", vehicle_settings=tables)
    kinds: dict = dict(zip(BUILT_IN, (MockParameters, HunterSettings, Ros2Settings), strict=True))
    for name, kind in kinds.items():
        assert convert(tables[name], kind) == kind()
    keys = [key for kind in (Config, *kinds.values()) for key in kind.__struct_fields__]
    missing = [key for key in keys if f"{key} =" not in example.read_text()]
    assert missing == ["ride_through", "vehicle_settings"]


@pytest.mark.parametrize("topic", ["status", "rearm"])
def test_an_answer_that_is_no_json_or_none_is_one_line(topic, refuses):
    endpoint, key = free_endpoint(), f"phil/hunter01/{topic}"
    with open_session(listen=endpoint, mode="router") as session:
        refuses([topic, "--connect", endpoint], "no edge runtime")
        session.declare_queryable(key, lambda query: query.reply(key, b"[" * 100_000))
        refuses([topic, "--connect", endpoint], "JSON")


@pytest.mark.parametrize(
    ("command", "stop"),
    [({"session": "a", "episode": 2}, "a/2/0"), (None, "None/None/0"), (b"[", "none seen")],
)
def test_a_re_arm_is_for_the_stop_that_is_seen_when_it_is_typed(command, stop, capsys):
    endpoint, asked = free_endpoint(), []
    status, rearm = ("phil/hunter01/status", "phil/hunter01/rearm")
    bad = command if isinstance(command, bytes) else b""
    reply = bad or json.dumps(a_status(command=command)).encode()

    def answer(query):
        asked.append(bytes(query.payload).decode())
        query.reply(rearm, b'{"accepted": true}')

    with open_session(listen=endpoint, mode="router") as session:
        session.declare_queryable(status, lambda query: query.reply(status, reply))
        session.declare_queryable(rearm, answer)
        assert exit_status(main, ["rearm", "--connect", endpoint]) == 0
    assert asked == [stop]


def a_status(**changes):
    action = [{"name": "pedal"}, {"name": "steering"}]
    about = {"manifest": {"action": action, "task": "t"}, "command": None, "feedback": None}
    return {**msgspec.to_builtins(HEALTH), **about, **changes}


def test_a_phone_shows_what_matters_beside_the_vehicle():
    nothing = "\n".join(render(a_status()))
    assert "nobody: no vehicle" in nothing
    feedback = msgspec.to_builtins(make_feedback(3, speed_mps=0.25, battery_v=24.5, sent_ns=10**9))
    known = {
        "vehicle": "hunter", "sent_ns": 10**9, "feedback": {**feedback, "action": [0.25, -0.5]},
        "command": {"action": [1.0, -0.5]}, "max_speed_mps": 0.3, "leash_m": 5.0,
        "leash_left_m": 3.2, "link": dict.fromkeys(FIELDS, 12.3), "temperature_c": 48.0,
    }  # fmt: skip
    lines = render(a_status(mode="drive", **known))
    told = dict(line.split(maxsplit=1) for line in lines if not line.startswith(("link", "moved")))
    assert told["asked"] == "pedal 1.00, steering -0.50"
    assert told["achieved"] == "pedal 0.25, steering -0.50"
    assert [told[name].split()[0] for name in ("speed", "cap", "leash", "battery", "board")] == [
        "0.25", "0.30", "3.20", "24.50", "48.00",
    ]  # fmt: skip
    assert max(map(len, lines)) <= 48
    assert any("THE POLICY" in line for line in lines)
    waits = render(a_status(mode="safe_stop", reason="episode", needs_rearm=True, **known))
    assert any("NOBODY" in line for line in waits)
    assert any("safe_stop episode" in line for line in waits)
    old = render(a_status(**{**known, "sent_ns": 5 * 10**9}))
    assert sum("not heard for 4 s" in line for line in old) == 2


def test_a_watch_goes_on_until_it_is_interrupted():
    endpoint, key = free_endpoint(), "phil/hunter01/status"
    reply = json.dumps(a_status(reason="\x1b[2J")).encode()
    with open_session(listen=endpoint, mode="router") as session:
        answers = session.declare_queryable(key, lambda query: query.reply(key, reply))
        with Process("edge_runtime", "status", "--watch", "--connect", endpoint) as shown:
            wait_until(lambda: shown.output.count("moved by") >= 2, "two looks")
            answers.undeclare()
            shown.wait_for_line("NO ANSWER")
            shown.send(signal.SIGINT)
            assert shown.wait() == 130
    assert all(line.isprintable() for line in shown.output.splitlines())


def test_an_error_or_a_status_holds_nothing_that_a_terminal_acts_upon():
    hostile = "\x1b[2J\x1b]0;owned\x07\x9b31m\u202e\r\n\udcff"
    assert str(UserError(f"no file {hostile}")).isprintable()
    health = msgspec.structs.asdict(HEALTH)
    status = {key: hostile if isinstance(value, str) else value for key, value in health.items()}
    more = {"rejected": {hostile: 1}, "manifest": {"task": hostile}, "version": hostile}
    assert all(line.isprintable() for line in render_status({**status, **more}).splitlines())


def test_a_command_that_cannot_print_its_result_ends_in_order(make_policy):
    run = ["run", *make_policy().flags, "--connect", "tcp/127.0.0.1:1"]
    for command, lines in ((["--help"], 1), (run, 4)):
        shell = ["sh", "-c", 'exec "$@" > /dev/full', "sh", sys.executable, "-m", "edge_runtime"]
        environment = {**os.environ, "PYTHONUNBUFFERED": ""}
        done = subprocess.run([*shell, *command], capture_output=True, text=True, env=environment)
        assert (done.returncode, "Traceback" in done.stderr) == (2, False)
        assert done.stderr.count("\n") <= lines
        assert "No space left on device" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("kind", "taken", "refused"),
    [
        (cli.positive, "1", ["0", "1.5"]),
        (cli.not_negative, "0", ["-1", "many", str(2**63)]),
        (cli.not_negative, str(2**63 - 1), [str(2**63)]),
        (cli.positive_number, "1e-9", ["0", "inf"]),
        (cli.not_negative_number, "0", ["nan"]),
        (cli.seconds, "0.5", ["-0.1"]),
        (cli.seconds, "1e9", ["1e10"]),  # no clock takes it
    ],
)
def test_numbers_within_and_beyond_their_limits(kind, taken, refused):
    assert kind(taken) == pytest.approx(float(taken))
    for text in refused:
        with pytest.raises(ArgumentTypeError, match=f"'{text}'"):
            kind(text)


def test_an_unknown_option_is_guessed_before_one_is_missed_and_help_breaks_no_name(capsys):
    parser = cli.ArgumentParser(prog="x")
    parser.add_argument("--max-minutes", required=True, help="like " + "--out-of-range " * 20)
    for words, said in (
        (["--max-minutess", "3"], "--max-minutess; did you mean --max-minutes"),
        (["--max-minuts=3"], "--max-minuts; did you mean --max-minutes"),
        (["--quux"], "--quux"),
    ):
        with pytest.raises(SystemExit, match="2"):
            parser.parse_args(words)
        assert capsys.readouterr().err == f"x: there is no option {said} (see x --help)\n"
    assert parser.format_help().split().count("--out-of-range") == 20


def test_a_policy_that_is_slow_here_may_not_drive(refuses, make_policy, monkeypatch):
    monkeypatch.setattr(commands, "quantiles_ms", lambda _: {"p50": 1.0, "p99": 143.0, "max": 150})
    refuses(["check", *make_policy().flags[1:]], "143 ms")
