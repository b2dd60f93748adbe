"""Valid certificates without the right: what they say goes nowhere, and they hear nothing.

At a router, too: what stands in the file of a fleet's router, and that the router holds to it.
"""

from __future__ import annotations

import contextlib
import json
import re
import time

import pytest

from bridge.__main__ import main as bridge
from bridge.tests.harness import SLOW_TOY, BridgeProcess, make_policy, read, wait_until_driving
from deploy.__main__ import main as deploy
from edge_runtime.commands import ask
from edge_runtime.link_probe import free_endpoint
from edge_runtime.tests.harness import EdgeProcess, run_command
from edge_runtime.tls import load_tls, rules_for_edge, rules_for_listener
from edge_runtime.util import UserError
from hil_tests.processes import Process
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
    ("who", "is_believed"), [("simulator-hunter01", True), ("simulator-hunter02", False)]
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


def edge_flags(endpoint, parties, folder):
    policy = make_policy(folder, "constant", 0.1)
    flags = ["--policy", str(policy), "--allow-unsigned", "--connect", endpoint]
    return [*flags, "--tls", str(parties / "edge-hunter01")]


@pytest.mark.parametrize("is_there_first", [True, False])
def test_another_vehicles_simulator_ends_no_edge_by_a_forged_token(
    parties, tmp_path, is_there_first
):
    """Posing as the server, it claims that an elder runtime has this vehicle's id."""
    endpoint, anything_goes = free_endpoint("tls"), {"enabled": False}
    flags = edge_flags(endpoint, parties, tmp_path)
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
    endpoint = free_endpoint("tls")
    flags = edge_flags(endpoint, parties, tmp_path)
    with (
        listener(endpoint, parties / who, rules_for_listener(["hunter01"])),
        EdgeProcess(*flags) as edge,
    ):
        second = run_command("run", *flags)
        assert second.returncode == 2
        assert "another edge runtime is connected" in second.stderr
        assert edge.end() == 0


VEHICLES = ("hunter01", "hunter02")


def router_file(endpoint, parties, out, rights=True):
    words = ["router", "--listen", endpoint, "--tls", str(parties / "router"), "--out", str(out)]
    assert deploy([*words, *(word for each in VEHICLES for word in ("--vehicle-id", each))]) == 0
    settings = json.loads(out.read_text())
    settings["access_control"]["enabled"] = rights
    out.write_text(json.dumps(settings))
    return str(out)


@pytest.mark.parametrize(
    ("rights", "heard"),
    # Without rights, too: what makes the first row mean something.
    [(True, {"phil/hunter01/state"}), (False, {f"phil/{each}/state" for each in VEHICLES})],
)
def test_a_vehicle_at_a_router_hears_only_its_own(parties, tmp_path, rights, heard):
    endpoint, found = free_endpoint("tls"), []
    path = router_file(endpoint, parties, tmp_path / "r.json5", rights)
    with (
        Process("bridge", "router", "--config", path, ready="ready"),
        contextlib.ExitStack() as opened,
    ):
        edge, *simulators = (
            opened.enter_context(session(endpoint, parties / name))
            for name in ("edge-hunter01", *(f"simulator-{each}" for each in VEHICLES))
        )
        subscribers = [
            edge.declare_subscriber(key, lambda sample: found.append(str(sample.key_expr)))
            for key in ("phil/**", "phil/hunter01/state", "phil/hunter02/state")
        ]
        time.sleep(SETTLE_S)
        for simulator, vehicle in zip(simulators, VEHICLES, strict=True):
            simulator.put(f"phil/{vehicle}/state", b"go")
        time.sleep(SETTLE_S)
        for subscriber in subscribers:
            subscriber.undeclare()
    assert set(found) == heard


def test_a_routers_file_names_the_vehicles_of_both_options(parties, tmp_path, capsys):
    listed, out = tmp_path / "fleet.txt", tmp_path / "router.json5"
    listed.write_text("# the yard\nhunter02\n\nhunter03  # at the gate\n")
    words = ["router", "--listen", "tls/127.0.0.1:7447", "--tls", str(parties / "router")]
    words += ["--vehicle-id", "hunter01", "--vehicles", str(listed), "--out", str(out)]
    assert deploy(words) == 0
    assert "3 vehicles" in capsys.readouterr().out
    settings = json.loads(out.read_text())
    rules = settings["access_control"]
    names = {subject["id"] for subject in rules["subjects"]}
    assert names >= {f"edge-hunter0{i}" for i in (1, 2, 3)}
    assert (rules["enabled"], rules["default_permission"]) == (True, "deny")
    assert settings["mode"] == "router"
    assert settings["listen"]["endpoints"] == ["tls/127.0.0.1:7447"]
    tls = settings["transport"]["link"]["tls"]
    assert tls["enable_mtls"] is True
    assert tls["listen_certificate"] == str(parties / "router" / "cert.pem")
    assert settings["transport"]["link"]["protocols"] == ["tls", "quic"]
    assert settings["scouting"]["multicast"]["enabled"] is False


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (["--listen", "tcp/127.0.0.1:7447"], "plain text"),
        (["--tls", "viewer"], "certificate of viewer"),
        (["--vehicle-id", "a/b"], "not valid"),
        (["--vehicles", "nowhere.txt"], "does not exist"),
        (["--out", "/dev/null/r.json5"], "Not a directory"),
    ],
)
def test_a_routers_file_is_refused_where_it_would_not_hold(parties, tmp_path, change, says):
    options = {
        "--listen": "tls/127.0.0.1:7447",
        "--tls": "router",
        "--vehicle-id": "hunter01",
        "--out": str(tmp_path / "r.json5"),
    }
    options |= dict([change])
    options["--tls"] = str(parties / options["--tls"])
    with pytest.raises(UserError, match=says):
        deploy(["router", *(word for pair in options.items() for word in pair)])
    assert not list(tmp_path.iterdir())


def test_a_router_says_what_is_wrong_with_its_file(tmp_path):
    path = tmp_path / "r.json5"
    path.write_text('{"mode": "router", "nonsense": 3}')

    with pytest.raises(UserError, match="nonsense"):
        bridge(["router", "--config", str(path)])
    with pytest.raises(UserError, match="no other option"):
        bridge(["router", "--config", str(path), "--listen", free_endpoint()])
