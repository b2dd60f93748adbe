"""Mutual TLS: who gets a link at all, and what those with a valid certificate may say and hear."""

import contextlib
import datetime
import ipaddress
import json
import re
import shutil
import time
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from bridge.ports import SimulatorPort
from bridge.recording import Recording
from deploy.__main__ import main as deploy
from deploy.certs import CLOCK_SLACK, _pem, issue, read_authority
from edge_runtime import wire
from edge_runtime.link import ask
from edge_runtime.reach import free_endpoint
from edge_runtime.tls import load_tls, rules_for_edge, rules_for_listener
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from hil_tests.processes import Process
from hil_tests.tests.shared.commands import run_command
from hil_tests.tests.shared.drives import SLOW_TOY, make_policy, read, run_edge
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import T

SETTLE_S = 0.4
"""Until both ends know of a declaration, and until what must not come would have come."""
VEHICLES = ("hunter01", "hunter02")
LISTENERS = ("viewer", "shadow-hunter01")
STRANGERS = ("edge-hunter02", "simulator-hunter02", "operator-hunter02", *LISTENERS)
FOREIGN = {"malformed", "foreign_session"}


@pytest.fixture(scope="module")
def parties(tmp_path_factory):
    """Certificates for hunter01 and hunter02, and in `foreign` those of another authority."""
    folder = tmp_path_factory.mktemp("tls") / "certs"
    vehicles = [f"--vehicle-id={each}" for each in VEHICLES]
    assert deploy(["certs", "--out", str(folder), *vehicles]) == 0
    assert deploy(["certs", "--out", str(folder / "foreign")]) == 0
    return folder


def session(endpoint, folder, mode="client", rules=None):
    """Connect with the files of a folder, plain without one."""
    tls = None if folder is None else load_tls(folder)
    return open_session(connect=endpoint, mode=mode, tls=tls, access=rules)


def listener(endpoint, folder, rules):
    return open_session(listen=endpoint, mode="router", tls=load_tls(folder), access=rules)


class Intruder:
    """Says all that it should not about hunter01, and listens for all that it should not hear."""

    def __init__(self, opened: zenoh.Session, stack: contextlib.ExitStack) -> None:
        self._session = opened
        self.heard: set[str] = set()
        for keys in ("**", "phil/**", "phil/hunter01/state", "phil/hunter01/command"):
            hears: Any = {"handler": self._hear, "allowed_origin": zenoh.Locality.REMOTE}
            stack.enter_context(opened.declare_subscriber(keys, **hears))
        tokens = ("phil/hunter01/*", self._hear)
        stack.enter_context(opened.liveliness().declare_subscriber(*tokens, history=True))

    def speak(self) -> None:
        state = wire.encode(make_state(10**6, session="intruder"))
        for topic in ("state", "command", "feedback", "health", "scene"):
            self._session.put(f"phil/hunter01/{topic}", state)
            self._session.put(f"phil/hunter01/{topic}", b"broken")
            self._session.delete(f"phil/hunter01/{topic}")

    def ask(self) -> None:
        """Query for anything of hunter01, and for the router's insides."""
        keys = ("phil/hunter01/*", "phil/hunter01/status", "phil/hunter01/rearm", "@/**")
        self._asked = [self._session.get(key, timeout=1.0) for key in keys]
        self._asked += [self._session.liveliness().get("phil/hunter01/alive", timeout=1.0)]

    def answers(self) -> set[str]:
        """The keys that answered."""
        # A session answers for itself, from its own memory; nobody else may.
        own, replies = (
            str(self._session.info.zid()),
            [reply for each in self._asked for reply in each],
        )
        return {key for r in replies if r.ok and own not in (key := str(r.ok.key_expr))}

    def _hear(self, sample: Any) -> None:
        self.heard.add(str(sample.key_expr))


def edge_flags(endpoint, folder, files=None):
    flags = ["--policy", str(make_policy(folder, "constant", 0.1)), "--allow-unsigned"]
    return [*flags, "--connect", endpoint, *(["--tls", str(files)] if files else [])]


@pytest.fixture(scope="module")
def endpoint(parties):
    place = free_endpoint("tls")
    with listener(place, parties / "router", rules_for_listener(["hunter01"])):
        yield place


def test_zenoh_lets_in_only_who_shows_a_certificate_of_the_authority(parties, endpoint):
    def bare(place, **tls):
        """Zenoh itself, past all checks of ours."""
        settings = {
            "mode": "client", "connect": {"endpoints": [place]},
            "scouting": {"multicast": {"enabled": False}}, "transport": {"link": {"tls": tls}},
        }  # fmt: skip
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))

    def shows(folder):
        names = {"connect_certificate": "cert.pem", "connect_private_key": "key.pem"}
        files = {option: str(parties / folder / name) for option, name in names.items()}
        return {**ca, "enable_mtls": True, **files}

    ca = {"root_ca_certificate": str(parties / "ca/ca.pem")}
    foreign = shows("foreign/viewer")
    bare(endpoint, **shows("viewer")).close()  # So that what follows is refused for its reason.
    for place, tls in ((endpoint, foreign), (endpoint, ca), (endpoint.replace("tls", "tcp"), {})):
        with pytest.raises(zenoh.ZError):
            bare(place, **tls)


def test_our_own_line_names_the_party(parties, endpoint):
    foreign = load_tls(parties / "foreign/edge-hunter01")
    for tls, says in ((foreign, "as edge-hunter01"), (None, "needs certificates")):
        for mode in ("client", "peer"):  # A peer would go on trying in silence.
            with pytest.raises(UserError, match=says):
                open_session(connect=endpoint, mode=mode, tls=tls)


@pytest.mark.parametrize(("who", "host"), [("viewer", "127.0.0.1"), ("router", "127.0.0.2")])
def test_a_listener_needs_its_own_servers_certificate(parties, who, host):
    """Anybody with a certificate could pose as the simulator else."""
    place = free_endpoint("tls").replace("127.0.0.1", host)
    with (
        listener(place, parties / who, rules_for_listener(["hunter01"])),
        pytest.raises(UserError, match="no TLS link"),
    ):
        open_session(connect=place, mode="client", tls=load_tls(parties / "edge-hunter01"))


def short_lived(parties, folder, life_s):
    """A party's files, named by their folder, whose certificate ends in so many seconds."""
    shutil.copytree(parties / folder.name, folder)
    born = datetime.datetime.now(datetime.UTC) - CLOCK_SLACK + datetime.timedelta(seconds=life_s)
    hosts = [x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    role = folder.name.partition("-")[0]
    issued = issue(read_authority(parties / "ca"), folder.name, role, hosts, born, days=1)
    (folder / "cert.pem").write_bytes(issued.certificate.public_bytes(Encoding.PEM))
    (folder / "key.pem").write_bytes(_pem(issued.key))
    return folder


def expired_in(line, folder):
    return line.startswith(f"error: {folder}/cert.pem expired at ")


def test_a_certificate_that_really_expires_stops_the_vehicle(parties, tmp_path):
    """This listener does not end by itself. Zenoh closes the link, and mostly has it again."""
    place = free_endpoint("tls")
    commands: list[Any] = []
    flags = edge_flags(place, tmp_path, parties / "edge-hunter01")
    with run_edge(*flags, "--vehicle", "mock") as edge:
        files = short_lived(parties, tmp_path / "simulator-hunter01", 4.0)
        ends_s = load_tls(files).expires.timestamp()
        with (
            listener(place, files, rules_for_listener(["hunter01"])) as ours,
            contextlib.closing(SimulatorPort(ours, "hunter01")) as port,
        ):
            port.hear("command", lambda payload: commands.append(wire.decode_command(payload)))
            for step in range(10_000):
                port.publish_state(wire.encode(make_state(step, session=port.session)))
                time.sleep(0.05)
                if time.time() > ends_s + 1.0:
                    break
        assert edge.end() == 0
    drives = [each.sent_ns / 1e9 for each in commands if each.mode == wire.DRIVE]
    assert len(drives) > 5
    # Of a state that came before, and answered within T.
    assert max(drives) < ends_s + 2 * T
    modes = [line for line in edge.errors.splitlines() if " mode was=" in line]
    assert "now=safe_stop" in modes[-1]
    assert "waits_for_rearm" in edge.errors


def test_every_process_ends_with_its_certificate(parties, tmp_path):
    place, out = free_endpoint("tls"), tmp_path / "drive.mcap"
    edge_files, simulator, viewer, router, beside = files = [
        short_lived(parties, tmp_path / name, life_s)
        for name, life_s in
        (("edge-hunter01", 7.0), ("simulator-hunter01", 8.0), ("viewer", 8.0), ("router", 10.0),
         ("shadow-hunter01", 9.0))
    ]  # fmt: skip
    flags = edge_flags(place, tmp_path, edge_files)
    where = ("--connect", place, "--tls")
    drive = ("--env", SLOW_TOY, "--episodes", "999", "--clock", "realtime")
    with (
        Process("bridge", "router", "--listen", place, "--tls", str(router)) as hub,
        Process("bridge", "simulate", *drive, *where, str(simulator)) as run,
        run_edge(*flags, "--vehicle", "mock") as edge,
        Process("bridge", "record", "--out", str(out), *where, str(viewer)) as recorder,
        Process("bridge", "shadow", *flags[:3], *where, str(beside)) as shadow,
    ):
        edge.wait_for_line("now=drive")
        for process, folder in zip((edge, run, recorder, hub, shadow), files, strict=True):
            assert process.wait() == 2
            assert expired_in(process.errors.splitlines()[-1], folder), process.errors
            assert "Traceback" not in process.errors
    recording = Recording(out)
    assert list(recording.messages())
    assert (recording.cut_off, recording.damaged_places) == (False, 0)
    again = run_command("run", *flags)
    assert (again.returncode, expired_in(again.stderr, edge_files)) == (2, True)


def drive_among(intruders, endpoint, flags, folder):
    """The report, the edge's log, and by name what each intruder heard and was answered."""
    out = folder / "r.json"
    simulate = ["simulate", "--env", SLOW_TOY, "--episodes", "2", "--listen", endpoint]
    with (
        Process("bridge", *simulate, "--out", str(out), *flags("simulator-hunter01")) as run,
        run_edge(*edge_flags(endpoint, folder), *flags("edge-hunter01")) as edge,
    ):
        edge.wait_for_line("now=drive")
        with contextlib.ExitStack() as opened:
            present = {
                name: Intruder(opened.enter_context(session(endpoint, files)), opened)
                for name, files in intruders.items()
            }
            time.sleep(SETTLE_S)
            for intruder in present.values():
                intruder.speak()
                intruder.ask()
            loot = {name: (each.heard, each.answers()) for name, each in present.items()}
        assert run.wait() == 0, run.errors
        assert edge.end() == 0
    return read(out), edge.errors, loot


def test_a_drive_over_mutual_tls_among_intruders(parties, tmp_path):
    endpoint = free_endpoint("tls")
    strangers = {name: parties / name for name in STRANGERS}
    report, log, loot = drive_among(
        strangers, endpoint, lambda name: ["--tls", str(parties / name)], tmp_path
    )
    # A pause of a busy machine may make a message stale; these are an intruder's only.
    assert not FOREIGN & set(report["rejected"])
    assert int(re.findall(r"accepted=(\d+)", log)[-1]) >= 30
    for name in set(STRANGERS) - set(LISTENERS):
        assert loot[name] == (set(), set()), name
    for name, may_ask in zip(LISTENERS, ({"phil/hunter01/status"}, set()), strict=True):
        heard, answered = loot[name]
        assert {f"phil/hunter01/{suffix}" for suffix in ("state", "command", "alive")} <= heard
        assert answered - {"phil/hunter01/alive"} == may_ask, name


def test_without_tls_the_same_intruder_gets_through(tmp_path):
    """What makes the test above mean something."""
    report, _, loot = drive_among({"anybody": None}, free_endpoint(), lambda _: [], tmp_path)
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
        edge.declare_queryable("phil/hunter01/rearm", rearmed),
    ):
        time.sleep(SETTLE_S)
        for name in STRANGERS:
            with pytest.raises(UserError, match=f"{name} may not ask"):
                ask(endpoint, "hunter01", "rearm", load_tls(parties / name))
        assert calls == []
        own = load_tls(parties / "operator-hunter01")
        assert ask(endpoint, "hunter01", "rearm", own) == {"accepted": True}
        assert calls == ["phil/hunter01/rearm"]


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
        edge.declare_subscriber("phil/hunter01/state", states.append),
    ):
        time.sleep(SETTLE_S)
        simulator.put("phil/hunter01/state", b"go")
        time.sleep(SETTLE_S)
    assert len(states) == int(is_believed)


def test_a_forged_token_of_another_vehicle_ends_no_edge(parties, tmp_path):
    """Posing as the server, it claims that an elder runtime has this vehicle's id."""
    endpoint, anything_goes = free_endpoint("tls"), {"enabled": False}
    flags = edge_flags(endpoint, tmp_path, parties / "edge-hunter01")
    with contextlib.ExitStack() as opened:
        posing = listener(endpoint, parties / "simulator-hunter02", anything_goes)
        liveliness = opened.enter_context(posing).liveliness()
        for end in ("", "/0-elder"):
            opened.enter_context(liveliness.declare_token(f"phil/hunter01/alive{end}"))
        edge = opened.enter_context(run_edge(*flags))
        time.sleep(4 * SETTLE_S)  # it looks twice within a second of the link
        assert edge.end() == 0
    assert "another" not in edge.errors


def test_a_vehicle_at_a_router_hears_only_its_own(parties):
    endpoint, found = free_endpoint("tls"), []
    words = ["--listen", endpoint, "--tls", str(parties / "router")]
    words += [f"--vehicle-id={each}" for each in VEHICLES]
    with (
        Process("bridge", "router", *words, ready="ready"),
        contextlib.ExitStack() as opened,
    ):
        edge, *simulators = (
            opened.enter_context(session(endpoint, parties / name))
            for name in ("edge-hunter01", *(f"simulator-{each}" for each in VEHICLES))
        )
        for key in ("phil/**", "phil/hunter01/state", "phil/hunter02/state"):
            hear = edge.declare_subscriber(key, lambda sample: found.append(str(sample.key_expr)))
            opened.enter_context(hear)
        time.sleep(SETTLE_S)
        for simulator, vehicle in zip(simulators, VEHICLES, strict=True):
            simulator.put(f"phil/{vehicle}/state", b"go")
        time.sleep(SETTLE_S)
    assert set(found) == {"phil/hunter01/state"}


def test_a_robots_own_senses_speak_as_the_simulator_of_its_vehicle(parties, tmp_path):
    source = "import numpy as np\nclass Source:\n    observe = lambda self: "
    source += "{'frames': np.random.randint(0, 99, (2, 45, 80), np.uint8)}\n"
    (tmp_path / "own_source.py").write_text(source)
    place, policy = free_endpoint("tls"), make_policy(tmp_path, "constant", 0.1)

    def sense(party, *where):
        words = ("--source", "own_source:Source", "--policy", policy, "--allow-unsigned")
        tls = ("--tls", parties / party)
        return Process("bridge", "sense", *words, *where, *tls, cwd=tmp_path)

    with sense("viewer", "--listen", place) as refused:
        assert refused.wait() == 2
    own, flags = "simulator-hunter01", edge_flags(place, tmp_path, parties / "edge-hunter01")
    with sense(own, "--listen", place) as listens, run_edge(*flags) as edge:
        edge.wait_for_line("now=drive")
        listens.kill()
        edge.wait_for_line("now=safe_stop")
    router = listener(place, parties / "router", rules_for_listener(["hunter01"]))
    with router, sense(own, "--connect", place) as connects, run_edge(*flags):
        connects.wait_for_line("says drive")
