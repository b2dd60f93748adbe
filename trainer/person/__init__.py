"""A person at the wheel: drives, takes over from a policy, and is recorded."""

import os

# Before SDL starts: no greeting on stdout, its signal handlers would eat ^C, a wheel must work
# while another window has the focus, and Mesa's OpenGL brings an LLVM that kills Triton, which the
# CUDA build of torch imports.
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")
os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
