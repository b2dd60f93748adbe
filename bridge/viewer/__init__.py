"""What ``python -m bridge view`` is made of: the feed from the wire, and its picture in rerun."""
