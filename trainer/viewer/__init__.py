"""What ``trainer train --rerun`` is made of: a watcher of the loop, and its picture in rerun."""

import bridge.rerun  # noqa: F401 (before rerun: what it logs is chosen there)
