"""The file of a fleet's router: what stands in it, and that a router holds to it."""

from __future__ import annotations

import contextlib
import json
import time

import pytest

from bridge.__main__ import main as bridge
from deploy.__main__ import main as deploy
from edge_runtime.errors import UserError
from edge_runtime.transport import free_endpoint
from hil_tests.faults.processes import Process
from hil_tests.tests.tls_parties import SETTLE_S, make_certificates, session

VEHICLES = ("hunter01", "hunter02")


@pytest.fixture(scope="module")
def parties(tmp_path_factory):
    return make_certificates(tmp_path_factory.mktemp("tls") / "certs")


def router_file(endpoint, parties, out, rights=True):
    words = ["router", "--listen", endpoint, "--tls", str(parties / "router"), "--out", str(out)]
    assert deploy([*words, *(word for each in VEHICLES for word in ("--vehicle-id", each))]) == 0
    settings = json.loads(out.read_text())
    settings["access_control"]["enabled"] = rights
    out.write_text(json.dumps(settings))
    return str(out)


@contextlib.contextmanager
def router(path):
    process = Process("bridge", "router", "--config", path)
    try:
        process.wait_for_line("ready")
        yield
    finally:
        process.end()


@pytest.mark.parametrize(
    ("rights", "heard"),
    # Without rights, too: what makes the first row mean something.
    [(True, {"phil/hunter01/state"}), (False, {f"phil/{each}/state" for each in VEHICLES})],
)
def test_a_vehicle_at_a_router_hears_only_its_own(parties, tmp_path, rights, heard):
    endpoint, found = free_endpoint("tls"), []
    with (
        router(router_file(endpoint, parties, tmp_path / "r.json5", rights)),
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
