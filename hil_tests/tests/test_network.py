"""The kernel network: its parts without root, and (marker ``network``) the loop over it."""

from __future__ import annotations

import json
import subprocess

import pytest

from bridge.network import parse_spec
from edge_runtime.util import UserError
from hil_tests.commands import BackgroundCommand
from hil_tests.network import cells
from hil_tests.network.cells import Cell, Drive, run_cell, summary
from hil_tests.network.command import POLICY, PUBLIC_KEY, show
from hil_tests.network.kernel import kernel_network
from hil_tests.network.namespaces import why_not
from hil_tests.network.netem import netem_arguments
from hil_tests.network.report import table, write_report


@pytest.fixture
def kernel():
    """Skips where the machine cannot, with the reason."""
    if why_not():
        pytest.skip(why_not())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("50ms+-10ms,loss=1%", "delay 50ms 10ms distribution normal loss random 1%"),
        ("50ms,tail=pareto,duplicate=2%", "delay 50ms 0ms duplicate 2%"),
        # p = r s / (1 - s) with r = 1/4, s = 0.1: 2.778 %; delivered inside of bursts never.
        ("loss=10%,burst=4", "delay 0ms 0ms loss gemodel 2.77778% 25% 100% 0%"),
        # 4 Mbit/s for 300 ms are 150 kB, a hundred packets.
        ("rate=4Mbit/s,queue=300ms", "delay 0ms 0ms rate 4000kbit limit 100"),
    ],
)
def test_netem_is_told_the_same(text, words):
    assert " ".join(netem_arguments(parse_spec(text).up)) == words


@pytest.mark.parametrize("text", ["outage=1s@2s", "order=kept", "reorder=1%", "tail=lognormal"])
def test_what_netem_has_not_is_said(text):
    with pytest.raises(UserError, match="netem has no " + text.split("=1%")[0].split("=1s")[0]):
        netem_arguments(parse_spec(text).up)


REPORT = {
    "per_episode": [{"steps": 60}, {"steps": 40}],
    "answered_states": 95,
    "latency_ms": {"p50": 51.2, "p90": 58.0, "p99": 250.0, "max": 301.0},
    "safe_stops": 2,
    "safe_stop_events": [{"reason": "no_command"}, {"reason": "no_fresh_state"}],
    "success_rate": 0.5,
    "tick_overruns": 1,
    "rejected_by_edge": {"stale": 3},
    "rejected_by_simulator": {},
}


def test_the_share_of_unanswered_states_is_of_all_that_were_sent():
    found = summary(REPORT)
    assert found["unanswered_percent"] == pytest.approx(5.0)
    assert found["states"] == 100


def test_the_table_and_the_picture_show_every_cell(tmp_path):
    rows = [
        {"row": "clean", "latency_spec": "delay=25ms", "transport": name, **summary(REPORT)}
        | {"failed_starts": ["late"]}
        for name in cells.TRANSPORTS
    ]
    dead = {"latency_spec": "loss=50%", "transport": "udp", "failed_starts": ["no"] * 3}
    rows.append({"row": "dead", **dead})
    mute = {**summary(REPORT), "round_trip_ms": dict.fromkeys(("p50", "p90", "p99", "max"))}
    rows.append({**rows[0], **mute, "row": "half dead"})
    write_report({"rows": rows}, tmp_path)
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert len(lines) == 2 + len(rows)
    assert lines[2] == (
        "| `delay=25ms` | Zenoh on TCP | 51 | 58 | 250 | 301 | 5.0 % | 2 | 50% | 1 |"
    )
    assert (tmp_path / "quantiles.png").read_bytes().startswith(b"\x89PNG")
    assert table({"rows": []}).count("\n") == 2


def test_a_cell_without_an_answer_has_its_line():
    cell = Cell("clean", "udp", parse_spec("delay=25ms"))
    mute = {**summary(REPORT), "round_trip_ms": dict.fromkeys(("p50", "p90", "p99", "max"))}
    assert "p99      - ms" in show(cell, {**mute, "failed_starts": []})
    assert "p99  250.0 ms" in show(cell, {**summary(REPORT), "failed_starts": []})
    assert "never started: no" in show(cell, {"failed_starts": ["no"]})


def devices_and_namespaces():
    """What a kernel network must not leave behind."""
    commands = (("ip", "netns"), ("ip", "-brief", "link"))
    return [
        sorted(line.split()[0] for line in out.splitlines())
        for out in (
            subprocess.run(command, check=True, capture_output=True, text=True).stdout
            for command in commands
        )
    ]


@pytest.mark.usefixtures("kernel")
@pytest.mark.network
def test_a_kernel_network_delays_and_leaves_nothing_behind():
    before = devices_and_namespaces()
    with kernel_network(parse_spec("up.delay=30ms,down.delay=60ms"), 0, "test") as cable:
        echo = (
            "import socket, time; s = socket.socket(socket.AF_INET, socket.SOCK_STREAM);"
            f"t = time.monotonic(); r = s.connect_ex(('{cable.address}', 9));"
            "print(r, time.monotonic() - t)"
        )
        command = [*cable.edge, "python3", "-c", echo]
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    status, round_trip_s = out.split()
    assert int(status) == 111  # Refused by the other end: the answer has come all the way.
    assert float(round_trip_s) >= 0.09
    assert devices_and_namespaces() == before


@pytest.mark.usefixtures("kernel")
@pytest.mark.network
def test_an_error_inside_leaves_nothing_behind():
    before = devices_and_namespaces()
    with (
        pytest.raises(UserError, match="no policy file"),
        kernel_network(parse_spec("10ms"), 0, "test") as cable,
        BackgroundCommand("bridge", "simulate", "--env", "left_turn", prefix=cable.simulator),
    ):
        raise UserError("no policy file")
    assert devices_and_namespaces() == before


@pytest.mark.usefixtures("kernel")
@pytest.mark.network
@pytest.mark.parametrize("transport", ["tcp", "udp", "udp_jumbo"])
def test_the_loop_drives_through_the_kernel(transport, tmp_path):
    drive = Drive(POLICY, PUBLIC_KEY, 1, 0, tmp_path)
    found = run_cell(drive, Cell("test", transport, parse_spec("30ms")))
    assert 60 <= found["round_trip_ms"]["p50"] < 120
    assert found["states"] > 20
    json.dumps(found, allow_nan=False)
