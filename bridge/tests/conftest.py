"""Property tests compute; on a busy machine they are given the time."""

from hypothesis import settings

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
