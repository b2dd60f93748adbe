"""What ``python -m bridge view`` is made of: the feed from the wire, and its picture in rerun."""

import viewing  # noqa: F401 (before rerun: what it logs is chosen there)
