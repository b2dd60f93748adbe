import contextlib
import datetime
import shutil
import stat

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization as form
from cryptography.x509.oid import ExtendedKeyUsageOID

from deploy.__main__ import main
from deploy.certs import _pem, issue, read_authority
from edge_runtime.tls import load_tls
from edge_runtime.util import UserError
from hil_tests.testing.commands import exit_status

PARTIES = {"router", "viewer", "edge-hunter01", "simulator-hunter01", "operator-hunter01"}


def make(folder, *options):
    return exit_status(main, ["certs", "--out", str(folder), *options])


def extension(folder, kind):
    certificate = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
    return certificate.extensions.get_extension_for_class(kind).value


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "certs"
    assert make(folder) == 0
    return folder


@pytest.fixture
def party(made, tmp_path):
    shutil.copytree(made / "edge-hunter01", tmp_path / "party")
    return tmp_path / "party"


def test_each_party_has_what_it_needs_and_no_more(made):
    assert {p.name for p in made.iterdir()} == {*PARTIES, "ca"}
    for name in PARTIES:
        assert {p.name for p in (made / name).iterdir()} == {"ca.pem", "cert.pem", "key.pem"}
        assert load_tls(made / name).name == name
        usage = extension(made / name, x509.ExtendedKeyUsage)
        assert ExtendedKeyUsageOID.CLIENT_AUTH in usage
        is_server = name in ("router", "simulator-hunter01")
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
    assert {path: after[path] for path in before} == before
    new = {f"{role}-two" for role in ("edge", "simulator", "operator")}
    assert {p.parts[0] for p in set(after) - set(before)} == new
    names = extension(folder / "simulator-two", x509.SubjectAlternativeName)
    assert set(names.get_values_for_type(x509.DNSName)) == {"localhost", "bench.local"}
    addresses = {str(a) for a in names.get_values_for_type(x509.IPAddress)}
    assert addresses == {"127.0.0.1", "::1", "10.0.0.7"}
    (folder / "ca/ca.key.pem").unlink()
    assert make(folder, "--vehicle-id", "new") == 2


@pytest.mark.parametrize(
    "options",
    [
        *("hunter01", "a/b", "x" * 55, "new --host tcp/host:1", "new --days 99999999999"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(made, options, capsys):
    before = contents(made)
    assert make(made, "--vehicle-id", *options.split()) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert contents(made) == before


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("ca.pem", None),
        ("cert.pem", ""),
        *((n, "other") for n in ("ca.pem", "cert.pem", "key.pem")),
    ],
)
def test_a_file_that_is_missing_no_pem_or_another_partys_is_refused(party, made, name, content):
    (party / name).unlink()
    if content is not None:
        (party / name).write_text(content)
    if content == "other":
        make(made.parent / "other")
        shutil.copyfile(made.parent / "other/edge-hunter01" / name, party / name)
    with pytest.raises(UserError, match=name):
        load_tls(party)


@pytest.mark.parametrize(("mode", "is_fine"), [(0o440, True), (0o644, False), (0o660, False)])
def test_a_key_that_others_can_read_is_refused(party, mode, is_fine):
    (party / "key.pem").chmod(mode)
    with contextlib.nullcontext() if is_fine else pytest.raises(UserError, match="chmod 600"):
        load_tls(party)


@pytest.mark.parametrize(("shift_days", "match"), [(-30, "expired"), (30, "clock")])
def test_a_certificate_outside_its_time_says_so(party, made, shift_days, match):
    then = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=shift_days)
    issued = issue(read_authority(made / "ca"), "edge-hunter01", "edge", [], then, days=5)
    (party / "cert.pem").write_bytes(issued.certificate.public_bytes(form.Encoding.PEM))
    (party / "key.pem").write_bytes(_pem(issued.key))
    with pytest.raises(UserError, match=match):
        load_tls(party)


def test_a_pair_is_private_and_never_overwritten(tmp_path, capsys):
    keys = ["keys", "--out", str(tmp_path / "keys")]
    assert exit_status(main, keys) == 0
    private = tmp_path / "keys/policy.key"
    pem = private.read_bytes()
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    capsys.readouterr()
    assert exit_status(main, keys) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert private.read_bytes() == pem
