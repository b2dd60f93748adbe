"""Wheels unpacked without pip, and the lock that says which."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest

from deploy import bundle
from deploy.bundle import TARGETS, Pin, gather, lock_path, read_lock
from deploy.installer.layout import unpack_wheel
from deploy.installer.verify import UserError as InstallerError
from deploy.tests.boards import HERE
from edge_runtime.util import UserError


def wheel(*members: str) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name in members:
            archive.writestr(name, name)
    return packed.getvalue()


def unpacked(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_packages_come_out_and_scripts_stay_in(tmp_path):
    data = wheel(
        "a/__init__.py", "a-1.dist-info/RECORD", "a-1.data/purelib/b.py", "a-1.data/platlib/c/d.so",
        "a-1.data/scripts/tool", "a-1.data/headers/a.h", "a-1.data/data/share/x",
    )  # fmt: skip
    unpack_wheel(data, "a-1.whl", tmp_path)
    assert unpacked(tmp_path) == {"a/__init__.py", "a-1.dist-info/RECORD", "b.py", "c/d.so"}


@pytest.mark.parametrize(
    "name", ["../x.py", "/x.py", "a/../../x.py", "a\\..\\x.py", "a-1.data/purelib/../../x.py"]
)
def test_a_name_that_leaves_the_folder_is_refused(tmp_path, name):
    with pytest.raises(InstallerError, match="outside"):
        unpack_wheel(wheel(name), "a-1.whl", tmp_path / "site")
    assert not (tmp_path / "x.py").exists()


def test_two_wheels_may_not_hold_the_same_file(tmp_path):
    unpack_wheel(wheel("a.py"), "a-1.whl", tmp_path)
    for clash in ("a.py", "a.py/b.py", "b-1.data/purelib/a.py"):
        with pytest.raises(InstallerError, match="another wheel"):
            unpack_wheel(wheel(clash), "b-1.whl", tmp_path)


@pytest.mark.parametrize(
    "data", [b"", b"no zip", wheel("a.py")[:-30]], ids=["empty", "no zip", "cut off"]
)
def test_what_is_no_wheel_is_said(tmp_path, data):
    with pytest.raises(InstallerError, match="is not a wheel"):
        unpack_wheel(data, "a-1.whl", tmp_path)


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_every_target_is_locked_by_hash(target):
    pins = read_lock(lock_path(target))
    names = {pin.name for pin in pins}
    assert {"numpy", "onnxruntime", "eclipse-zenoh", "msgspec", "cryptography", "tomli"} <= names
    assert len(names) == len(pins)


def test_the_twin_has_the_boards_versions():
    board, twin = (read_lock(lock_path(TARGETS[n])) for n in ("jetpack5", "linux-x86_64"))
    assert [pin[:2] for pin in board] == [pin[:2] for pin in twin]


@pytest.mark.parametrize("line", ["numpy", "numpy>=1", "numpy==1.0", "numpy==1 --hash=sha256:ab"])
def test_a_lock_without_version_or_hash_is_refused(tmp_path, line):
    path = tmp_path / "lock.txt"
    path.write_text(f"# a lock\n\n{line}\n")
    with pytest.raises(UserError, match=r"lock\.txt: not NAME==VERSION"):
        read_lock(path)


def test_a_full_folder_needs_no_network(tmp_path, monkeypatch):
    monkeypatch.setattr(bundle, "pip", lambda *_: pytest.fail("pip was asked"))
    (tmp_path / "a-1-py3-none-any.whl").write_bytes(b"")
    (tmp_path / "other-1-py3-none-any.whl").write_bytes(b"other")
    lock = tmp_path / "lock.txt"
    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    lock.write_text(f"a==1 --hash=sha256:{empty}\n")
    assert read_lock(lock) == [Pin("a", "1", empty)]
    assert gather(HERE, lock, tmp_path) == [tmp_path / "a-1-py3-none-any.whl"]


def test_a_wheel_with_another_hash_is_not_taken(tmp_path, monkeypatch):
    """The real pip: it finds no such version, or reaches no index; either is one line."""
    (tmp_path / "a-1-py3-none-any.whl").write_bytes(b"changed")
    lock = tmp_path / "lock.txt"
    lock.write_text(f"phil-edge-runtime==0.0.1 --hash=sha256:{'0' * 64}\n")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(UserError, match="pip download: ERROR: No matching distribution"):
        gather(HERE, lock, tmp_path)
