import io
import os
import random
import subprocess
import tarfile
import zipfile

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy import bundle as bundle_module
from deploy.bundle import pack, sign
from deploy.installer import verify
from deploy.installer.layout import unpack_wheel
from deploy.tests.boards import HERE
from edge_runtime.util import UserError
from hil_tests.testing.policies import public_pem

KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))
PUBLIC = public_pem(KEY)
FILES = {"config.toml": b"a = 1\n", "empty": b"", "wheels/a-1.whl": bytes(range(256)) * 5}
MANIFEST = verify.BundleManifest("0.1.0-a-b", HERE, "hunter01", "p" * 64)
CONTENTS = {**FILES, verify.MANIFEST: verify.to_json(MANIFEST)}


def write(path, data: bytes, key: Ed25519PrivateKey = KEY) -> None:
    path.write_bytes(data)
    path.with_name(f"{path.name}.sig").write_bytes(sign(data, key))


@pytest.fixture
def bundle(tmp_path):
    write(tmp_path / "bundle.tar", pack(CONTENTS))
    return tmp_path / "bundle.tar"


def refused(path, match: str | None = None) -> None:
    with pytest.raises(UserError, match=match):
        verify.read_bundle(str(path), PUBLIC)


def test_what_was_put_in_comes_out_and_others_read_it_too(bundle, tmp_path):
    assert verify.read_bundle(str(bundle), PUBLIC) == (MANIFEST, CONTENTS)
    subprocess.run(["tar", "--extract", "--file", bundle], cwd=tmp_path, check=True)
    assert all((tmp_path / name).read_bytes() == data for name, data in CONTENTS.items())


def test_any_one_byte_changed_is_found(bundle):
    whole, choice = bundle.read_bytes(), random.Random(7)
    for place in choice.sample(range(len(whole)), 30):
        data = bytearray(whole)
        data[place] ^= choice.randrange(1, 256)
        bundle.write_bytes(data)
        refused(bundle, "changed")


def test_a_signature_of_another_key_or_for_another_use_is_refused(bundle, monkeypatch):
    data = bundle.read_bytes()
    write(bundle, data, Ed25519PrivateKey.generate())
    refused(bundle, "not trusted")
    monkeypatch.setattr(bundle_module, "NAMESPACE", "file")
    write(bundle, data)
    refused(bundle, "not trusted")
    bundle.with_name("bundle.tar.sig").unlink()
    refused(bundle, "signature")


def tar_of(*kinds: bytes) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        for kind in kinds:
            member = tarfile.TarInfo("a")
            member.type, member.linkname = kind, "config.toml"
            tar.addfile(member)
    return packed.getvalue()


NAMES = ("/etc/passwd", "a/../../x", "a//b", "", ".hidden", "a/.", "a\nb")
KINDS = (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE)
STRANGE = {
    **{f"name {name!r}": pack({**CONTENTS, name: b"x"}) for name in NAMES},
    **{f"kind {kind!r}": tar_of(kind) for kind in KINDS},
    "file twice": tar_of(tarfile.REGTYPE, tarfile.REGTYPE),
    "empty": b"",
    "no tar": b"no tar",
    "no manifest": pack(FILES),
}


@pytest.mark.parametrize("what", STRANGE)
def test_what_is_signed_and_no_bundle_is_refused(bundle, what):
    write(bundle, STRANGE[what])
    refused(bundle)


@pytest.mark.parametrize(
    "raw",
    [
        *(b"", b"[]", b"{}", verify.to_json(MANIFEST).replace(b'"format":1', b'"format":2')),
        *(verify.to_json(MANIFEST._replace(version=version)) for version in ("../x", "")),
    ],
)
def test_a_manifest_that_makes_no_sense_is_refused(raw):
    with pytest.raises(UserError):
        verify.parse_manifest(raw)


@pytest.mark.parametrize("name", ["missing.tar", "pipe"])
def test_what_cannot_be_read_is_refused(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    refused(tmp_path / name)


def test_a_key_is_the_same_however_its_lines_end_and_what_is_none_is_refused(tmp_path):
    path, foreign = tmp_path / "key.pub", public_pem(ec.generate_private_key(ec.SECP256R1()))
    path.write_bytes(PUBLIC.replace(b"\n", b"\r\n"))
    assert verify.key_name(verify.read_public_key(str(path))) == verify.key_name(PUBLIC)
    for wrong in (b"\xff\xfe", foreign, PUBLIC[:-40]):
        path.write_bytes(wrong)
        with pytest.raises(UserError):
            verify.read_public_key(str(path))


def test_packages_come_out_of_a_wheel_and_nothing_leaves_its_folder(tmp_path):
    wanted = {"a/__init__.py", "a-1.dist-info/RECORD", "b.py", "c/d.so", "x.py", "a/x.py"}
    members = ("a/__init__.py", "a-1.dist-info/RECORD", "a-1.data/purelib/b.py",
               "a-1.data/platlib/c/d.so", "a-1.data/scripts/tool", "a-1.data/data/share/x",
               "../x.py", "/x.py", "a/../../x.py", "a-1.data/purelib/../../x.py")  # fmt: skip
    packed, site = io.BytesIO(), tmp_path / "site"
    with zipfile.ZipFile(packed, "w") as archive:
        for name in members:
            archive.writestr(name, name)
    unpack_wheel(packed.getvalue(), site)
    assert {p.relative_to(site).as_posix() for p in site.rglob("*") if p.is_file()} == wanted
    assert [path.name for path in tmp_path.iterdir()] == ["site"]
