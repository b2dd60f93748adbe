"""A fleet at one router: everybody drives, nobody hears another, and the numbers add up."""

from __future__ import annotations

import json

import pytest

from deploy.__main__ import main as deploy
from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import UserError
from hil_tests.__main__ import main
from hil_tests.fleet import drive
from hil_tests.fleet.scale import per_vehicle, project
from hil_tests.fleet.usage import Carried, parse, why_not_counted

THREE = 3
STATE_KBIT_S = 7_200 * 10 * 8e-3
"""Two frames, ten times a second, without anything around them."""


def test_three_vehicles_drive_and_hear_only_their_own(tmp_path):
    report = drive.measure(THREE, 1.0, tmp_path)
    assert report["foreign_messages"] == 0
    assert report["answered_least"] > 0.5
    if not why_not_counted():
        assert report["link_of_an_edge_kbit_s"]["receives"] > 0.5 * STATE_KBIT_S
        assert report["link_of_a_simulator_kbit_s"]["sends"] > 0.5 * STATE_KBIT_S
    assert report["message_bytes"]["state"] > 7_200
    assert report["router_resident_mb"] > 1


def test_without_rights_everybody_hears_everybody(tmp_path, monkeypatch):
    """What makes the test above mean something."""
    written = drive.write_router_config

    def without_rights(*arguments):
        path = written(*arguments)
        settings = json.loads(path.read_text())
        settings["access_control"]["enabled"] = False
        path.write_text(json.dumps(settings))
        return path

    monkeypatch.setattr(drive, "write_router_config", without_rights)
    assert drive.measure(2, 0.5, tmp_path, restart=False)["foreign_messages"] > 0


LISTING = (
    'x y users:(("python",pid=7,fd=3)) cubic bytes_sent:10 bytes_acked:11 bytes_received:200 z\n'
    'x y users:(("python",pid=7,fd=4)) cubic bytes_sent:1 bytes_received:2 z\n'
    'x y users:(("python",pid=8,fd=4)) cubic z\n'
    'x y users:(("python",pid=9,fd=4)) cubic bytes_sent:5 z\n'
    "nobody's\n"
)


def test_bytes_of_links_by_process():
    assert parse(LISTING, [7, 8]) == {7: Carried(11, 202), 8: Carried(0, 0)}


def fleet(vehicles):
    """Each vehicle adds 0.5 % of a core and 0.2 MB to a router's 30 MB."""
    return {
        "vehicles": vehicles,
        "router_cpu_percent_of_a_core": 1.0 + 0.5 * vehicles,
        "router_resident_mb": 30 + 0.2 * vehicles,
        "message_bytes": {"health": 500},
        "link_of_a_simulator_kbit_s": {"sends": 600.0, "receives": 30.0},
        "link_of_an_edge_kbit_s": {"sends": 30.0, "receives": 600.0},
    }


def test_many_more_from_what_each_adds():
    each = per_vehicle([fleet(1), fleet(10), fleet(20)])
    assert each["router_cpu_percent_of_a_core"] == pytest.approx(0.5)
    assert each["router_resident_mb"] == pytest.approx(0.2)
    assert each["router_in_kbit_s"] == 630.0
    ten, thousand, most = project(each, [{"vehicles": 100, "file_bytes": 500_000}])
    # Half a core at 0.5 % each: 100 vehicles; the link would bear 793.
    assert ten["vehicles_a_router_at_most"] == 100
    assert [ten["routers"], thousand["routers"], most["routers"]] == [1, 10, 1000]
    assert ten["certificates"] == 32
    assert most["health_of_all_mbit_s"] == pytest.approx(100_000 * 500 * 8 * 2 / 1e6)
    assert most["all_routers_in_gbit_s"] == pytest.approx(63.0)
    assert thousand["rules_file_mb"] == pytest.approx(0.5)


def test_one_size_has_no_slope():
    with pytest.raises(ValueError, match="no slope"):
        per_vehicle([fleet(3), fleet(3)])
    with pytest.raises(UserError, match="two sizes"):
        main(["fleet", "--vehicles", "3"])


@pytest.fixture(scope="module")
def router_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls") / "certs"
    assert deploy(["certs", "--out", str(folder)]) == 0
    return folder


def test_a_routers_file_names_the_vehicles_of_both_options(router_folder, tmp_path, capsys):
    listed, out = tmp_path / "fleet.txt", tmp_path / "router.json5"
    listed.write_text("# the yard\nhunter02\n\nhunter03  # at the gate\n")
    words = ["router", "--listen", "tls/127.0.0.1:7447", "--tls", str(router_folder / "router")]
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
    assert tls["listen_certificate"] == str(router_folder / "router" / "cert.pem")
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
def test_a_routers_file_is_refused_where_it_would_not_hold(router_folder, tmp_path, change, says):
    options = {
        "--listen": "tls/127.0.0.1:7447",
        "--tls": "router",
        "--vehicle-id": "hunter01",
        "--out": str(tmp_path / "r.json5"),
    }
    options |= dict([change])
    options["--tls"] = str(router_folder / options["--tls"])
    with pytest.raises(UserError, match=says):
        deploy(["router", *(word for pair in options.items() for word in pair)])
    assert not list(tmp_path.iterdir())


def test_a_router_says_what_is_wrong_with_its_file(tmp_path):
    path = tmp_path / "r.json5"
    path.write_text('{"mode": "router", "nonsense": 3}')
    from bridge.__main__ import main as bridge

    with pytest.raises(UserError, match="nonsense"):
        bridge(["router", "--config", str(path)])
    with pytest.raises(UserError, match="no other option"):
        bridge(["router", "--config", str(path), "--listen", free_endpoint()])
