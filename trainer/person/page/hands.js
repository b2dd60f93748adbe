// Keyboard and sliding pad. A held key or finger takes over; letting go hands control back.

// A pedal is down in 0.2 s; a wheel is turned by a tap, not thrown. As in trainer/person/devices.py.
const KEYS = {
  left_turn: { plus: ["ArrowUp", "KeyW"], minus: ["ArrowDown", "KeyS"], perSecond: 5.0 },
  congestion: { plus: ["ArrowRight", "KeyD"], minus: ["ArrowLeft", "KeyA"], perSecond: 2.5 },
};
const FIRST_S = 0.1; // what a press is worth at once
const HOLD = "Space";
const DRIVING = new Set([HOLD, ...Object.values(KEYS).flatMap((keys) => [...keys.plus, ...keys.minus])]);
const WISHES = { KeyP: "pause", KeyR: "restart", Backspace: "discard", KeyQ: "quit" };

const clip = (value) => Math.min(Math.max(value, -1), 1);

export class Keyboard {
  constructor(changed, wish) {
    this.scenario = null; // until the first view: nothing is driven
    this.down = new Set();
    this.action = 0;
    this.changed = changed;
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.altKey || event.metaKey || typing(event.target)) return;
      if (event.code in WISHES && !event.repeat) return wish(WISHES[event.code]);
      if (!DRIVING.has(event.code)) return;
      event.preventDefault(); // neither scroll, nor press the button that was clicked last
      if (event.repeat) return;
      this.down.add(event.code);
      const first = this.way() * this.perSecond() * FIRST_S;
      // The other direction begins at once, from rest.
      if (this.action * first < 0 || Math.abs(this.action) < Math.abs(first)) this.action = first;
      changed();
    });
    addEventListener("keyup", (event) => {
      if (DRIVING.has(event.code) && !typing(event.target)) event.preventDefault();
      if (this.down.delete(event.code)) this.settle();
    });
    // A page without the focus hears no key come up.
    for (const gone of ["blur", "pagehide"]) addEventListener(gone, () => this.release());
    addEventListener("visibilitychange", () => document.hidden && this.release());
  }

  isDown(codes) {
    return codes.some((code) => this.down.has(code));
  }

  way() {
    const keys = KEYS[this.scenario];
    return keys ? this.isDown(keys.plus) - this.isDown(keys.minus) : 0;
  }

  perSecond() {
    return KEYS[this.scenario]?.perSecond ?? 0;
  }

  engaged() {
    const keys = KEYS[this.scenario];
    return Boolean(keys) && this.isDown([HOLD, ...keys.plus, ...keys.minus]);
  }

  // Grow towards what is held, fall back to nothing without.
  step(seconds) {
    const by = this.perSecond() * seconds;
    const target = this.engaged() ? this.way() : 0;
    const next = clip(this.action + Math.min(Math.max(target - this.action, -by), by));
    if (next !== this.action) {
      this.action = next;
      this.changed();
    }
  }

  settle() {
    if (!this.engaged()) this.action = 0;
    this.changed();
  }

  release() {
    this.down.clear();
    this.settle();
  }

  now() {
    return { action: this.action, engaged: this.engaged(), by_moving: false };
  }
}

export class Pad {
  constructor(element, knob, changed) {
    this.scenario = null;
    this.element = element;
    this.knob = knob;
    this.finger = null;
    this.action = 0;
    this.changed = changed;
    element.addEventListener("pointerdown", (event) => {
      if (this.finger !== null) return;
      this.finger = event.pointerId;
      element.setPointerCapture(event.pointerId);
      this.move(event);
      event.preventDefault();
    });
    element.addEventListener("pointermove", (event) => this.move(event));
    for (const up of ["pointerup", "pointercancel", "lostpointercapture"]) {
      element.addEventListener(up, (event) => event.pointerId === this.finger && this.release());
    }
    for (const gone of ["blur", "pagehide"]) addEventListener(gone, () => this.release());
  }

  move(event) {
    if (event.pointerId !== this.finger) return;
    const box = this.element.getBoundingClientRect();
    const upright = this.scenario === "left_turn";
    const share = upright
      ? 1 - (2 * (event.clientY - box.top)) / box.height
      : (2 * (event.clientX - box.left)) / box.width - 1;
    // The outer tenth is full action: a thumb need not find the edge.
    this.action = clip(share / 0.9);
    this.changed();
  }

  release() {
    if (this.finger === null) return;
    this.finger = null;
    this.action = 0;
    this.changed();
  }

  draw() {
    const upright = this.scenario === "left_turn";
    this.knob.style.left = `${upright ? 50 : 50 + 40 * this.action}%`;
    this.knob.style.top = `${upright ? 50 - 40 * this.action : 50}%`;
    this.element.classList.toggle("held", this.finger !== null);
  }

  now() {
    const engaged = this.finger !== null && this.scenario !== null;
    return { action: this.action, engaged, by_moving: false };
  }
}

const typing = (target) => ["INPUT", "SELECT", "TEXTAREA"].includes(target?.tagName);
