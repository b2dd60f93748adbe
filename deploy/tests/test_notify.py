"""What the installer hears of a service: readiness begins the watch, as systemd begins it."""

from __future__ import annotations

import os
import time

from deploy.installer.notify import NotifySocket
from edge_runtime.service import Notifier


def test_a_slow_start_is_no_silence(tmp_path):
    with NotifySocket(tmp_path) as heard:
        environment = heard.environment(3.0)
        service = Notifier({**environment, "WATCHDOG_PID": str(os.getpid())})
        assert service.watchdog_period_s == 1.5
        heard.last_ping_s = time.monotonic() - 20.0  # an emulated processor, or a cold disk
        service.ready("standby")
        heard.receive(1.0)
        assert (heard.ready, heard.pings) == (True, 0)
        assert time.monotonic() - heard.last_ping_s < 3.0


def test_pings_are_counted_and_forgotten_with_their_service(tmp_path):
    with NotifySocket(tmp_path) as heard:
        service = Notifier(heard.environment(3.0))
        service.status("drive")
        heard.receive(1.0)
        assert (heard.ready, heard.pings) == (False, 0)
        service.watchdog()
        service.watchdog()
        heard.receive(1.0)
        assert heard.pings == 2
        service.ready("standby")
        heard.forget()
        assert (heard.ready, heard.pings) == (False, 0)
