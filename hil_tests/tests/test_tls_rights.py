"""Valid certificates without the right: what they say goes nowhere, and they hear nothing."""

from __future__ import annotations

import contextlib
import re
import time

import pytest

from bridge.tests.harness import SLOW_TOY, BridgeProcess, make_policy, read, wait_until_driving
from edge_runtime.commands import ask
from edge_runtime.link_probe import free_endpoint
from edge_runtime.tests.harness import EdgeProcess, run_command
from edge_runtime.tls import load_tls, rules_for_edge, rules_for_listener
from edge_runtime.util import UserError
from hil_tests.tests.tls_parties import SETTLE_S, Intruder, listener, make_certificates, session

STRANGERS = ("edge-hunter02", "simulator-hunter02", "operator-hunter02", "viewer")
FOREIGN = {"malformed", "foreign_session"}
"""Why the edge runtime rejects what an intruder says, where it arrives."""


@pytest.fixture(scope="module")
def parties(tmp_path_factory):
    return make_certificates(tmp_path_factory.mktemp("tls") / "certs")


def drive_among(intruders, endpoint, flags, folder):
    """Drive while the intruders do their worst.

    Returns the report, the edge's log, and by name what each intruder heard and was answered.
    """
    policy, out = make_policy(folder, "constant", 0.1), folder / "r.json"
    edge_flags = ["--policy", str(policy), "--allow-unsigned", "--connect", endpoint]
    simulate = ["simulate", "--env", SLOW_TOY, "--episodes", "3", "--listen", endpoint]
    with (
        BridgeProcess(*simulate, "--out", str(out), *flags("simulator-hunter01")) as run,
        EdgeProcess(*edge_flags, *flags("edge-hunter01")) as edge,
    ):
        wait_until_driving(edge)
        with contextlib.ExitStack() as opened:
            present = {
                name: Intruder(opened.enter_context(session(endpoint, files)))
                for name, files in intruders.items()
            }
            time.sleep(SETTLE_S)
            for intruder in present.values():
                intruder.speak()
            loot = {name: (each.heard, set(each.ask())) for name, each in present.items()}
            for intruder in present.values():
                intruder.close()
        assert run.wait() == 0, run.errors
        assert edge.end() == 0
    return read(out), edge.log, loot


def test_episodes_over_mutual_tls_among_intruders(parties, tmp_path):
    endpoint = free_endpoint("tls")
    report, log, loot = drive_among(
        {name: parties / name for name in STRANGERS},
        endpoint,
        lambda name: ["--tls", str(parties / name)],
        tmp_path,
    )
    assert [row["outcome"] for row in report["per_episode"]] == ["timeout"] * 3
    # A pause of a busy machine may make a message stale; these are an intruder's only.
    assert not FOREIGN & set(report["rejected"])
    assert int(re.findall(r"accepted=(\d+)", log)[-1]) >= 100
    for name in STRANGERS[:-1]:
        assert loot[name] == (set(), set()), name
    heard, answered = loot["viewer"]
    assert {f"phil/hunter01/{suffix}" for suffix in ("state", "command", "alive")} <= heard
    assert answered - {"phil/hunter01/alive"} == {"phil/hunter01/status"}


def test_without_tls_the_same_intruder_gets_through(tmp_path):
    """What makes the test above mean something."""
    endpoint = free_endpoint()
    report, _, loot = drive_among({"anybody": None}, endpoint, lambda _: [], tmp_path)
    assert report["rejected_by_simulator"]["malformed"] > 0
    assert set(report["rejected_by_edge"]) >= FOREIGN
    heard, answered = loot["anybody"]
    assert {"phil/hunter01/state", "phil/hunter01/command"} <= heard
    assert {"phil/hunter01/status", "phil/hunter01/rearm"} <= answered


def test_an_operator_re_arms_its_own_vehicle_only(parties):
    endpoint, calls = free_endpoint("tls"), []

    def rearmed(query):
        calls.append(str(query.key_expr))
        query.reply(query.key_expr, b'{"accepted": true}')

    with (
        listener(endpoint, parties / "router", rules_for_listener(["hunter01", "hunter02"])),
        session(endpoint, parties / "edge-hunter01", "peer", rules_for_edge("hunter01")) as edge,
    ):
        queryable = edge.declare_queryable("phil/hunter01/rearm", rearmed)
        time.sleep(SETTLE_S)
        for name in STRANGERS:
            with pytest.raises(UserError, match=f"{name} may not ask"):
                ask(endpoint, "hunter01", "rearm", load_tls(parties / name))
        assert calls == []
        own = load_tls(parties / "operator-hunter01")
        assert ask(endpoint, "hunter01", "rearm", own) == {"accepted": True}
        assert calls == ["phil/hunter01/rearm"]
        queryable.undeclare()


@pytest.mark.parametrize(
    ("who", "is_believed"),
    [("simulator-hunter01", True), ("simulator-hunter02", False)],
)
def test_an_edge_takes_no_states_from_another_vehicles_simulator(parties, who, is_believed):
    """Its certificate is a server's of the same authority: TLS alone would let it pose."""
    endpoint = free_endpoint("tls")
    states: list[object] = []
    with (
        listener(endpoint, parties / who, rules_for_listener(["hunter01"])) as simulator,
        session(endpoint, parties / "edge-hunter01", "peer", rules_for_edge("hunter01")) as edge,
    ):
        subscriber = edge.declare_subscriber("phil/hunter01/state", states.append)
        time.sleep(SETTLE_S)
        simulator.put("phil/hunter01/state", b"go")
        time.sleep(SETTLE_S)
        subscriber.undeclare()
    assert len(states) == int(is_believed)


@pytest.mark.parametrize("is_there_first", [True, False])
def test_another_vehicles_simulator_ends_no_edge_by_a_forged_token(
    parties, tmp_path, is_there_first
):
    """Posing as the server, it claims that an elder runtime has this vehicle's id."""
    endpoint, anything_goes = free_endpoint("tls"), {"enabled": False}
    policy = make_policy(tmp_path, "constant", 0.1)
    flags = ["--policy", str(policy), "--allow-unsigned", "--connect", endpoint]
    flags += ["--tls", str(parties / "edge-hunter01")]
    with contextlib.ExitStack() as opened:
        edge = None if is_there_first else opened.enter_context(EdgeProcess(*flags))
        posing = listener(endpoint, parties / "simulator-hunter02", anything_goes)
        liveliness = opened.enter_context(posing).liveliness()
        tokens = [
            liveliness.declare_token(f"phil/hunter01/alive{claim}") for claim in ("", "/0-elder")
        ]
        edge = edge or opened.enter_context(EdgeProcess(*flags))
        assert edge.ready_line.startswith("ready ")
        time.sleep(4 * SETTLE_S)  # it looks twice within a second of the link
        assert edge.end() == 0
        for token in tokens:
            token.undeclare()
    assert "another" not in edge.log


@pytest.mark.parametrize("who", ["simulator-hunter01", "router"])
def test_a_second_runtime_is_still_refused_over_tls(parties, tmp_path, who):
    """What the test above must not have broken."""
    endpoint, policy = free_endpoint("tls"), make_policy(tmp_path, "constant", 0.1)
    flags = ["--policy", str(policy), "--allow-unsigned", "--connect", endpoint]
    flags += ["--tls", str(parties / "edge-hunter01")]
    with (
        listener(endpoint, parties / who, rules_for_listener(["hunter01"])),
        EdgeProcess(*flags) as edge,
    ):
        second = run_command("run", *flags)
        assert second.returncode == 2
        assert "another edge runtime is connected" in second.stderr
        assert edge.end() == 0
