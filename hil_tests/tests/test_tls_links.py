"""Who gets a link at all: one authority, a certificate in its time, TLS on both ends."""

from __future__ import annotations

import datetime
import json
import re
import shutil
import time

import pytest
import zenoh
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from bridge.ports import SimulatorPort, open_listener
from deploy.certs import CLOCK_SLACK, issue, read_authority
from edge_runtime import wire
from edge_runtime.tests.harness import EdgeProcess, make_state, run_command, wait_until
from edge_runtime.tests.policies import write_policy
from edge_runtime.tls import load_tls, rules_for_edge, rules_for_listener
from edge_runtime.transport import free_endpoint, look, open_session
from edge_runtime.util import UserError
from hil_tests.processes import Process
from hil_tests.tests.tls_parties import listener, make_certificates, session

LIFE_S = 2.0


@pytest.fixture(scope="module")
def parties(tmp_path_factory):
    return make_certificates(tmp_path_factory.mktemp("tls") / "certs")


@pytest.fixture(scope="module")
def endpoint(parties):
    """Where a router with access control listens."""
    place = free_endpoint("tls")
    with listener(place, parties / "router", rules_for_listener(["hunter01"])):
        yield place


def bare_session(endpoint, tls):
    """Zenoh itself, past all checks of ours: its `transport/link/tls` as given."""
    config = zenoh.Config()
    rows = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/link/tls": tls,
    }
    for name, value in rows.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


def test_zenoh_lets_in_only_who_shows_a_certificate_of_the_authority(parties, endpoint):
    ca = str(parties / "ca/ca.pem")
    own, foreign = parties / "viewer", parties / "foreign/viewer"

    def tls(folder):
        return {
            "root_ca_certificate": ca,
            "enable_mtls": True,
            "connect_certificate": str(folder / "cert.pem"),
            "connect_private_key": str(folder / "key.pem"),
        }

    bare_session(endpoint, tls(own)).close()  # So that what follows is refused for its reason.
    for refused in (tls(foreign), {"root_ca_certificate": ca}):
        with pytest.raises(zenoh.ZError):
            bare_session(endpoint, refused)
    with pytest.raises(zenoh.ZError):
        bare_session(endpoint.replace("tls/", "tcp/"), {})


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_our_own_line_says_why(parties, endpoint, mode):
    mixed = load_tls(parties / "foreign/edge-hunter01")
    with pytest.raises(UserError, match="not believed here"):
        open_session(connect=endpoint, mode=mode, tls=mixed)
    believing = type("Mixed", (type(mixed),), {"ca": str(parties / "ca/ca.pem")})(*mixed)
    with pytest.raises(UserError, match="refuses the certificate of edge-hunter01"):
        open_session(connect=endpoint, mode=mode, tls=believing)
    with pytest.raises(UserError, match="needs certificates"):
        open_session(connect=endpoint, mode=mode)
    if mode == "client":
        with pytest.raises(UserError, match="wants --tls"):
            open_session(connect=endpoint.replace("tls/", "tcp/"), mode=mode)


def test_an_edge_says_that_one_end_only_speaks_tls(parties, endpoint, policy_flags):
    plain = endpoint.replace("tls/", "tcp/")
    with EdgeProcess(*policy_flags, "--connect", plain) as edge:
        assert edge.process.stderr is not None
        line = next(line for line in edge.process.stderr if " waiting " in line)
        assert f"{plain} listens with TLS and wants --tls" in line
        assert edge.end() == 0
    place, files = free_endpoint("tls"), load_tls(parties / "edge-hunter01")
    simulator = open_session(listen=place.replace("tls/", "tcp/"), mode="router")
    _, said = look(place, files)
    simulator.close()
    assert re.match(f"{place} (does not speak TLS|answers, but not with TLS)", said)
    assert "connection refused" in look(place, files)[1]
    assert look(endpoint, files) == (True, "")


def test_a_viewers_certificate_is_no_servers(parties):
    """Or anybody with a certificate could pose as the simulator."""
    place = free_endpoint("tls")
    with (
        listener(place, parties / "viewer", rules_for_listener(["hunter01"])),
        pytest.raises(UserError, match="unsuitable certificate purpose"),
    ):
        open_session(connect=place, mode="peer", tls=load_tls(parties / "edge-hunter01"))


def test_an_address_that_the_certificate_does_not_name_is_refused(parties):
    port = free_endpoint("tls").rsplit(":", 1)[1]
    with (
        listener(f"tls/127.0.0.2:{port}", parties / "router", rules_for_listener(["hunter01"])),
        pytest.raises(UserError, match="IP address mismatch"),
    ):
        open_session(
            connect=f"tls/127.0.0.2:{port}", mode="client", tls=load_tls(parties / "viewer")
        )


def test_who_listens_with_certificates_must_say_who_may_do_what(parties):
    with pytest.raises(ValueError, match="access control"):
        open_session(listen=free_endpoint("tls"), mode="router", tls=load_tls(parties / "router"))


def test_a_link_ends_when_its_certificate_does(parties, endpoint, tmp_path):
    folder = tmp_path / "edge-hunter01"
    shutil.copytree(parties / "edge-hunter01", folder)
    authority = read_authority(parties / "ca")
    born = datetime.datetime.now(datetime.UTC) - CLOCK_SLACK
    life = datetime.timedelta(seconds=LIFE_S)
    issued = issue(authority, folder.name, "edge", [], born + life, days=1)
    (folder / "cert.pem").write_bytes(issued.certificate.public_bytes(Encoding.PEM))
    (folder / "key.pem").write_bytes(
        issued.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    )
    with session(endpoint, folder, "peer", rules_for_edge("hunter01")) as edge:
        assert edge.info.routers_zid()
        wait_until(lambda: not edge.info.routers_zid(), "the end of the link", LIFE_S + 5)
    with pytest.raises(UserError, match="expired at"):
        load_tls(folder)


@pytest.fixture
def policy_flags(tmp_path):
    """Flags of `run` for a small unsigned policy."""
    write_policy(tmp_path / "p.onnx")
    return ["--policy", str(tmp_path / "p.onnx"), "--allow-unsigned"]


def drive(port, answered, first_step):
    """Send states until commands have come back for some of them."""
    answered.clear()
    for step in range(first_step, first_step + 200):
        port.publish_state(wire.encode(make_state(step, session=port.session)))
        time.sleep(0.05)
        if len(answered) >= 5:
            return
    raise AssertionError(f"{len(answered)} commands within 10 s")


def start_router(endpoint, parties):
    words = ("bridge", "router", "--listen", endpoint, "--tls", str(parties / "router"))
    return Process(*words, ready=f"ready listen={endpoint}")


def test_edge_simulator_and_viewer_meet_at_a_router_that_comes_late_and_goes(parties, policy_flags):
    place = free_endpoint("tls")
    answered: list[bytes] = []
    flags = ["--connect", place, "--tls", str(parties / "edge-hunter01"), *policy_flags]
    with EdgeProcess(*flags) as edge:
        assert edge.ready_line.startswith("ready")
        router = start_router(place, parties)
        with session(place, parties / "simulator-hunter01") as simulator:
            port = SimulatorPort(simulator, "hunter01")
            port.on_command(answered.append)
            port.wait_for_edge(10.0, place)
            with open_listener(place, "hunter01", 5.0, load_tls(parties / "viewer")) as feed:
                drive(port, answered, 0)
                heard = [feed.next(1.0) for _ in range(8)]
                assert {"state", "command"} <= {each.topic for each in heard if each}
                assert router.end() == 0
                router = start_router(place, parties)
                drive(port, answered, 10**6)
            port.close()
        status = ["status", "--connect", place, "--tls", str(parties / "operator-hunter01")]
        assert run_command(*status).returncode == 0
        assert edge.end() == 0
    assert router.end() == 0


@pytest.mark.parametrize("name", ["operator-hunter01", "simulator-hunter01"])
def test_who_may_not_listen_is_told_so_and_not_that_nobody_is_there(parties, name):
    with (
        pytest.raises(UserError, match=f"of {name}, and this takes that of viewer"),
        open_listener(free_endpoint("tls"), "hunter01", 0.0, load_tls(parties / name)),
    ):
        pass
