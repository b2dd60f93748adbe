"""A wheel made of SDL's own virtual joystick: all is real but the plastic.

As a program, ``python -m trainer.person.tests.virtual_wheel COMMAND ...`` plugs one in, runs
``python -m trainer COMMAND ...`` in the same process, and obeys lines on stdin: ``axis N PLACE``,
``button N 0|1``; each is answered on stdout with ``did LINE TIME_NS``.
"""

import ctypes
import sys
import threading
import time
from pathlib import Path

AXES, BUTTONS = 4, 12
WHEEL_TYPE = 2
NAME = b"Virtual G29 wheel"


class Description(ctypes.Structure):
    """SDL_VirtualJoystickDesc, version 1 (SDL_joystick.h)."""

    _fields_ = [
        *((name, ctypes.c_uint16) for name in ("version", "type", "naxes", "nbuttons", "nhats")),
        *((name, ctypes.c_uint16) for name in ("vendor_id", "product_id", "padding")),
        *((name, ctypes.c_uint32) for name in ("button_mask", "axis_mask")),
        ("name", ctypes.c_char_p),
        ("userdata", ctypes.c_void_p),
        ("callbacks", ctypes.c_void_p * 6),
    ]


class VirtualWheel:
    """Plugged in when made; SDL must have been started with its joysticks."""

    def __init__(self):
        self._sdl = load_sdl()
        description = Description(1, WHEEL_TYPE, AXES, BUTTONS, name=NAME)
        self.index = self._sdl.SDL_JoystickAttachVirtualEx(ctypes.byref(description))
        if self.index < 0:
            raise RuntimeError(self._sdl.SDL_GetError().decode())
        self._joystick = self._sdl.SDL_JoystickOpen(self.index)

    def axis(self, number, place):
        place = ctypes.c_int16(round(place * 32767))
        self._sdl.SDL_JoystickSetVirtualAxis(self._joystick, number, place)

    def button(self, number, down):
        self._sdl.SDL_JoystickSetVirtualButton(self._joystick, number, ctypes.c_uint8(bool(down)))

    def unplug(self):
        self._sdl.SDL_JoystickDetachVirtual(self.index)


def load_sdl():
    """The very SDL that pygame has loaded; None where it has no virtual joysticks."""
    import pygame

    libraries = sorted((Path(pygame.__file__).parent.parent / "pygame_ce.libs").glob("libSDL2-2*"))
    if not libraries:
        return None
    sdl = ctypes.CDLL(str(libraries[0]))
    sdl.SDL_GetError.restype = ctypes.c_char_p
    sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
    sdl.SDL_JoystickSetVirtualAxis.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_int16]
    sdl.SDL_JoystickSetVirtualButton.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_uint8]
    return sdl if hasattr(sdl, "SDL_JoystickAttachVirtualEx") else None


def obey(wheel):
    for line in sys.stdin:
        what, number, value = line.split()
        {"axis": wheel.axis, "button": wheel.button}[what](int(number), float(value))
        print(f"did {line.strip()} {time.time_ns()}", flush=True)


def main(argv):
    from trainer.person.devices import pygame

    pygame.display.init()
    pygame.joystick.init()
    wheel = VirtualWheel()
    for pedal in (2, 3):
        wheel.axis(pedal, 1.0)
    threading.Thread(target=obey, args=(wheel,), daemon=True).start()

    from edge_runtime.cli import run_cli
    from trainer.__main__ import main as trainer

    return run_cli(trainer, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
