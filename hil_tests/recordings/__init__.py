"""The recording that the next release is replayed against, and the command that makes it."""
