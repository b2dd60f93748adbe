import io
import json
import random
import subprocess
import tarfile
import zipfile

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy.bundle import pack, sign
from deploy.installer import release
from deploy.installer.release import MANIFEST, Releases, read_bundle, read_public_key, unpack_wheel
from deploy.tests.boards import HERE
from edge_runtime.util import UserError
from hil_tests.tests.shared.policies import public_pem

KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))
FOREIGN = public_pem(ec.generate_private_key(ec.SECP256R1()))
ABOUT = release.Manifest("0.1.0-a-b", "hunter01", "p" * 64, *HERE)
FILES = {"config.toml": b"a = 1\n", "empty": b"", "wheels/a-1.whl": bytes(range(256)) * 5}
CONTENTS = {**FILES, MANIFEST: json.dumps(ABOUT._asdict()).encode()}


def write(path, data: bytes, key: Ed25519PrivateKey = KEY) -> None:
    path.write_bytes(data)
    path.with_name(f"{path.name}.sig").write_bytes(sign(data, key))


@pytest.fixture
def trusted(tmp_path):
    (tmp_path / "key.pub").write_bytes(public_pem(KEY))
    return read_public_key(tmp_path / "key.pub")


@pytest.fixture
def bundle(tmp_path):
    write(tmp_path / "bundle.tar", pack(CONTENTS))
    return tmp_path / "bundle.tar"


def test_what_was_put_in_comes_out_and_others_read_it_too(bundle, trusted, tmp_path):
    assert read_bundle(bundle, trusted) == (ABOUT, CONTENTS)
    subprocess.run(["tar", "--extract", "--file", bundle], cwd=tmp_path, check=True)
    assert all((tmp_path / name).read_bytes() == data for name, data in CONTENTS.items())


def test_any_one_byte_changed_is_found(bundle, trusted):
    whole, choice = bundle.read_bytes(), random.Random(7)
    for place in choice.sample(range(len(whole)), 30):
        data = bytearray(whole)
        data[place] ^= choice.randrange(1, 256)
        bundle.write_bytes(data)
        with pytest.raises(UserError, match="changed"):
            read_bundle(bundle, trusted)


def test_a_signature_of_another_key_or_use_or_none_is_refused(bundle, trusted, monkeypatch):
    data, signature = bundle.read_bytes(), bundle.with_name("bundle.tar.sig")
    write(bundle, data, Ed25519PrivateKey.generate())
    of_another = signature.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(release, "NAMESPACE", "file")
        write(bundle, data)
    for wrong in (signature.read_bytes(), of_another, b""):
        signature.write_bytes(wrong)
        with pytest.raises(UserError, match="not trusted"):
            read_bundle(bundle, trusted)


def link() -> bytes:
    packed, member = io.BytesIO(), tarfile.TarInfo("a")
    member.type = tarfile.SYMTYPE
    with tarfile.open(fileobj=packed, mode="w") as tar:
        tar.addfile(member)
    return packed.getvalue()


NAMES = ("/etc/passwd", "a/../../x", "a//b", "", ".hidden", "a/.", "a\nb")
STRANGE = {
    **{f"name {name!r}": pack({**CONTENTS, name: b"x"}) for name in NAMES},
    **{f"manifest {text!r}": pack({MANIFEST: text}) for text in (b"", b"[]", b"{}")},
    "link": link(),
    "no tar": b"no tar",
}


@pytest.mark.parametrize("what", STRANGE)
def test_what_is_signed_and_no_bundle_is_refused(bundle, trusted, what):
    write(bundle, STRANGE[what])
    with pytest.raises(UserError):
        read_bundle(bundle, trusted)


@pytest.mark.parametrize("wrong", [b"\xff\xfe", FOREIGN, public_pem(KEY)[:-40]])
def test_what_is_no_ed25519_key_is_refused(tmp_path, wrong):
    (tmp_path / "key.pub").write_bytes(wrong)
    with pytest.raises(UserError):
        read_public_key(tmp_path / "key.pub")


def wheel_of(*names: str) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name in names:
            archive.writestr(name, name)
    return packed.getvalue()


def test_a_release_can_be_read_by_the_service_and_its_keys_by_the_owner_alone(tmp_path):
    releases = Releases(str(tmp_path))
    with releases.locked():
        releases.unpack("1", {"wheels/a-1.whl": wheel_of("a/b.py"), "tls/key.pem": b"private"})
        modes = {"": 0o755, "tls/key.pem": 0o600, "bin/phil-edge": 0o755, "site-packages/a": 0o755}
        folder = releases.folder("1")
        assert {name: (folder / name).stat().st_mode & 0o777 for name in modes} == modes
        assert releases.is_whole("1")


def test_packages_come_out_of_a_wheel_and_nothing_leaves_its_folder(tmp_path):
    wanted = {"a/__init__.py", "a-1.dist-info/RECORD", "b.py", "c/d.so", "x.py", "a/x.py"}
    members = ("a/__init__.py", "a-1.dist-info/RECORD", "a-1.data/purelib/b.py",
               "a-1.data/platlib/c/d.so", "a-1.data/scripts/tool", "a-1.data/data/share/x",
               "../x.py", "/x.py", "a/../../x.py", "a-1.data/purelib/../../x.py")  # fmt: skip
    site = tmp_path / "site"
    unpack_wheel(wheel_of(*members), site)
    assert {p.relative_to(site).as_posix() for p in site.rglob("*") if p.is_file()} == wanted
    assert [path.name for path in tmp_path.iterdir()] == ["site"]
