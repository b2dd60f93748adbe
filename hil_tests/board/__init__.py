"""A board that is not there: its processor emulated, its files Debian's, its network loopback."""
