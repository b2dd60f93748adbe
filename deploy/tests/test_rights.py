"""Who may read, lock and name what on a board."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

from deploy.installer import __main__ as installer
from deploy.installer import layout as layout_module
from deploy.installer import systemctl
from deploy.installer.errors import UserError
from deploy.installer.layout import Layout
from deploy.installer.service import choose
from deploy.tests.boards import Board


def test_the_secret_is_the_owners_alone(board: Board, workshop, tmp_path):
    from deploy.__main__ import main

    assert main(["certs", "--out", str(tmp_path / "certs")]) == 0
    config = tmp_path / "c.toml"
    config.write_text('connect = "tls/127.0.0.1:9"\n')
    made = workshop.make(tls=tmp_path / "certs" / "edge-hunter01", config=config)
    before = os.umask(0o077)  # the caller's must not lock the service's user out
    try:
        assert board.install(made.path, "process").returncode == 0
    finally:
        os.umask(before)
    folder = board.root / "current"
    modes = {
        str(path.relative_to(folder)): path.stat().st_mode & 0o777
        for path in [folder / "tls/key.pem", folder / "config.toml", folder / "bin/phil-edge"]
    }
    assert modes == {"tls/key.pem": 0o600, "config.toml": 0o644, "bin/phil-edge": 0o755}
    assert (folder / "site-packages/edge_runtime").stat().st_mode & 0o777 == 0o755


def test_nobody_else_can_keep_the_service_silent(tmp_path, monkeypatch):
    """The hold is a lock: it is for the service's group to read, and asked for with a limit."""
    monkeypatch.setattr(layout_module, "_HOLD_LIMIT_S", 0.05)
    layout = Layout(str(tmp_path))
    with layout.locked():
        assert (tmp_path / ".lock").stat().st_mode & 0o777 == 0o600
        with layout.holding():
            assert layout.hold.stat().st_mode & 0o777 == 0o600
        with layout.holding(os.getgid()):
            assert layout.hold.stat().st_mode & 0o777 == 0o640
        with open(layout.hold) as other:
            fcntl.flock(other, fcntl.LOCK_SH)
            with pytest.raises(UserError, match="another process holds"), layout.holding():
                raise AssertionError("it has the lock")


@pytest.mark.parametrize("root", ["/opt/two words", "/opt/100%"])
def test_a_root_that_a_unit_file_cannot_name_is_refused(root, monkeypatch):
    monkeypatch.setattr(systemctl, "is_there", lambda: True)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    with pytest.raises(UserError, match="in a unit only"):
        choose("systemd", Path(root))


def test_whoever_may_not_read_the_key_is_told_the_rest(board: Board, workshop, monkeypatch, capsys):
    assert board.install(workshop.make(0.1).path).returncode == 0

    def may_not(folder: Path) -> str:
        raise PermissionError(13, "Permission denied", str(folder / "tls" / "key.pem"))

    monkeypatch.setattr(installer, "why_not_whole", may_not)
    assert installer.main(["status", "--root", str(board.root)]) == 0
    assert "not known: this user may not read" in capsys.readouterr().out
