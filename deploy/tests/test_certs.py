import datetime
import shutil
import stat

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from deploy.__main__ import main
from deploy.certs import _PEM, _pem, issue, read_authority
from edge_runtime.tls import load_tls
from edge_runtime.util import UserError
from hil_tests.tests.shared.commands import call, exit_status, refusal

ROLES = ("edge", "simulator", "operator", "shadow")
PARTIES = {"router", "viewer", *(f"{role}-hunter01" for role in ROLES)}


def make(folder, *options):
    return exit_status(main, ["certs", "--out", str(folder), *options])


def extension(folder, kind):
    pem = (folder / "cert.pem").read_bytes()
    return x509.load_pem_x509_certificate(pem).extensions.get_extension_for_class(kind).value


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "certs"
    assert make(folder) == 0
    return folder


@pytest.fixture
def party(made, tmp_path):
    return shutil.copytree(made / "edge-hunter01", tmp_path / "party")


def test_each_party_has_what_it_needs_and_no_more(made):
    assert {p.name for p in made.iterdir()} == {*PARTIES, "ca"}
    for name in PARTIES:
        assert {p.name for p in (made / name).iterdir()} == {"ca.pem", "cert.pem", "key.pem"}
        assert load_tls(made / name).name == name
        is_server = name in ("router", "simulator-hunter01")
        usage = extension(made / name, x509.ExtendedKeyUsage)
        assert (ExtendedKeyUsageOID.SERVER_AUTH in usage) is is_server
    for key in [*made.glob("*/key.pem"), made / "ca/ca.key.pem"]:
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
        assert stat.S_IMODE(key.parent.stat().st_mode) == 0o700


def test_what_is_missing_is_made_and_nothing_before_it_changes(tmp_path):
    folder = tmp_path / "certs"
    assert make(folder, "--vehicle-id", "one") == 0
    before = contents(folder)
    assert make(folder, "--vehicle-id", "two", "--host", "bench.local", "--host", "10.0.0.7") == 0
    after = contents(folder)
    assert before.items() <= after.items()
    new = {f"{role}-two" for role in ROLES}
    assert {p.parts[0] for p in set(after) - set(before)} == new
    names = extension(folder / "simulator-two", x509.SubjectAlternativeName)
    hosts = {str(name.value) for name in names}
    assert hosts == {"localhost", "127.0.0.1", "::1", "bench.local", "10.0.0.7"}


@pytest.mark.parametrize("options", ["hunter01", "a/b", "x" * 55, "new --host tcp/host:1"])
def test_bad_input_is_one_line_and_nothing_is_written(made, options, capsys):
    before = contents(made)
    refusal(capsys, "certs", "--out", made, "--vehicle-id", *options.split(), package="deploy")
    assert contents(made) == before


def test_an_authority_that_cannot_issue_is_refused(tmp_path, made, capsys):
    folder = shutil.copytree(made / "ca", tmp_path / "ca")
    old = issue(None, "old", "", (), datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC), 100)
    spoilt = (("ca.key.pem", _pem(old.key)), ("ca.pem", old.certificate.public_bytes(_PEM)))
    for name, data in (*spoilt, ("ca.pem", b"")):  # another's key, then an expired pair, then none
        (folder / name).write_bytes(data)
        refusal(capsys, "certs", "--out", tmp_path, package="deploy")
        assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize("name", ["ca.pem", "cert.pem", "key.pem"])
@pytest.mark.parametrize("fault", ["missing", "no PEM", "another's"])
def test_files_that_are_not_this_partys_are_refused(party, made, name, fault):
    (party / name).unlink()
    if fault == "no PEM":
        (party / name).touch(0o600)
    if fault == "another's":
        make(made.parent / "other")
        shutil.copyfile(made.parent / "other/edge-hunter01" / name, party / name)
    with pytest.raises(UserError, match=name):
        load_tls(party)


def test_a_group_may_read_a_key_and_nobody_else(party):
    (party / "key.pem").chmod(0o440)
    load_tls(party)
    for mode in (0o644, 0o660):
        (party / "key.pem").chmod(mode)
        with pytest.raises(UserError, match="chmod 600"):
            load_tls(party)


@pytest.mark.parametrize(("shift_days", "match"), [(-30, "expired"), (30, "clock")])
def test_a_certificate_outside_its_time_says_so(party, made, shift_days, match):
    then = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=shift_days)
    issued = issue(read_authority(made / "ca"), "edge-hunter01", "edge", [], then, days=5)
    (party / "cert.pem").write_bytes(issued.certificate.public_bytes(_PEM))
    (party / "key.pem").write_bytes(_pem(issued.key))
    with pytest.raises(UserError, match=match):
        load_tls(party)


def test_a_pair_is_private_and_never_overwritten(tmp_path, capsys):
    assert call(capsys, "keys", "--out", tmp_path, package="deploy")[0] == 0
    before = contents(tmp_path)
    assert stat.S_IMODE((tmp_path / "policy.key").stat().st_mode) == 0o600
    refusal(capsys, "keys", "--out", tmp_path, package="deploy")
    assert contents(tmp_path) == before
