// Keyboard and sliding pad. A held key or finger takes over; letting go hands control back.

// A view brings ``controls``: the keys, and what each adds to the action at rest; see ``Controls``
// of trainer/person/web.py. An action is one number, or a list of several.
const FIRST_S = 0.1; // a press counts at once as if held for this long
const HOLD = "space";
const WISHES = {
  KeyP: "pause", KeyR: "restart", Backspace: "discard", KeyQ: "quit", KeyY: "succeeded", KeyN: "failed",
};

const clip = (value) => Math.min(Math.max(value, -1), 1);
const keyOf = (code) => code.replace(/^(Arrow|Key|Digit)/, "").toLowerCase();
export const OFF = { action: null, engaged: false, by_moving: false };
export const list = (action) => [].concat(action ?? 0);
const plain = (values) => (values.length === 1 ? values[0] : values);

// The action for keys pressed by these shares, 0 to 1.
export function mix(controls, shares) {
  const added = list(controls.rest).map((rest, i) =>
    Object.entries(shares).reduce(
      (sum, [key, share]) => sum + share * (list(controls.keys[key])[i] ?? 0), rest));
  return plain(added.map(clip));
}

// Whether an environment has keys for left and right, and for up and down.
export const ways = (controls) => ({ aside: "left" in controls.keys, along: "up" in controls.keys });

export class Keyboard {
  constructor(changed, wish) {
    this.controls = null; // until the first view: nothing is driven
    this.down = new Set();
    this.pressed = []; // what the keys add to the action at rest
    this.changed = changed;
    addEventListener("keydown", (event) => {
      if (event.metaKey) this.release(); // macOS sends no keyup while Meta is held
      if (event.ctrlKey || event.altKey || event.metaKey || typing(event.target)) return;
      if (event.code in WISHES && !event.repeat) return wish(WISHES[event.code]);
      const key = keyOf(event.code);
      if (!this.drives(key)) return;
      event.preventDefault(); // do not scroll, or press the button that was clicked last
      if (event.repeat) return;
      this.down.add(key);
      this.pressed = this.way().map((way, i) => {
        const first = way * this.perSecond() * FIRST_S;
        const now = this.pressed[i] ?? 0;
        // The other direction begins at once, from rest.
        return now * first < 0 || Math.abs(now) < Math.abs(first) ? first : now;
      });
      changed();
    });
    addEventListener("keyup", (event) => {
      const key = keyOf(event.code);
      if (this.drives(key) && !typing(event.target)) event.preventDefault();
      if (this.down.delete(key)) this.settle();
    });
  }

  drives(key) {
    if (!this.controls) return key === HOLD || /^(up|down|left|right|[wasd])$/.test(key);
    return key === HOLD || key in this.controls.keys;
  }

  // The offset from rest that the held keys lead to.
  way() {
    if (!this.controls) return [];
    const held = Object.fromEntries([...this.down].map((key) => [key, 1]));
    const rest = list(this.controls.rest);
    return list(mix(this.controls, held)).map((wanted, i) => wanted - rest[i]);
  }

  perSecond() {
    return this.controls?.rate_per_s ?? 0;
  }

  engaged() {
    return this.controls !== null && [...this.down].some((key) => this.drives(key));
  }

  // Move towards the held keys' offset, or back to rest without any.
  step(seconds) {
    const by = this.perSecond() * seconds;
    const next = this.way().map((way, i) => {
      const now = this.pressed[i] ?? 0;
      return now + Math.min(Math.max((this.engaged() ? way : 0) - now, -by), by);
    });
    if (next.some((value, i) => value !== (this.pressed[i] ?? 0))) {
      this.pressed = next;
      this.changed();
    }
  }

  settle() {
    if (!this.engaged()) this.pressed = [];
    this.changed();
  }

  release() {
    this.down.clear();
    this.settle();
  }

  now() {
    const rest = list(this.controls?.rest);
    const action = plain(rest.map((value, i) => clip(value + (this.pressed[i] ?? 0))));
    return { action, engaged: this.engaged(), by_moving: false };
  }
}

export class Pad {
  constructor(element, knob, changed) {
    this.controls = null;
    this.element = element;
    this.knob = knob;
    this.finger = null;
    this.at = { aside: 0, along: 0 }; // the finger, right and up to 1
    this.changed = changed;
    element.addEventListener("pointerdown", (event) => {
      if (this.finger !== null || event.button !== 0) return;
      this.finger = event.pointerId;
      element.setPointerCapture(event.pointerId);
      this.move(event);
      event.preventDefault();
    });
    element.addEventListener("contextmenu", (event) => event.preventDefault()); // a long press
    element.addEventListener("pointermove", (event) => this.move(event));
    for (const up of ["pointerup", "pointercancel", "lostpointercapture"]) {
      element.addEventListener(up, (event) => event.pointerId === this.finger && this.release());
    }
  }

  move(event) {
    if (event.pointerId !== this.finger) return;
    if (!event.buttons) return this.release(); // the pointerup was missed
    const box = this.element.getBoundingClientRect();
    const along = 1 - (2 * (event.clientY - box.top)) / box.height;
    const aside = (2 * (event.clientX - box.left)) / box.width - 1;
    // The outer tenth is full action: a thumb need not find the edge.
    this.at = { aside: clip(aside / 0.9), along: clip(along / 0.9) };
    this.changed();
  }

  release() {
    if (this.finger === null) return;
    this.finger = null;
    this.at = { aside: 0, along: 0 };
    this.changed();
  }

  draw() {
    const can = this.controls ? ways(this.controls) : {};
    this.knob.style.left = `${50 + 40 * (can.aside ? this.at.aside : 0)}%`;
    this.knob.style.top = `${50 - 40 * (can.along ? this.at.along : 0)}%`;
    this.element.classList.toggle("held", this.finger !== null);
  }

  now() {
    if (!this.controls) return OFF;
    const action = mix(this.controls, shares(this.at));
    return { action, engaged: this.finger !== null, by_moving: false };
  }
}

// Convert the place of a stick, a wheel or a finger to shares of key presses.
export function shares({ aside = 0, along = 0 }) {
  const part = (value) => Math.max(value, 0);
  return { left: part(-aside), right: part(aside), up: part(along), down: part(-along) };
}

const typing = (target) => ["INPUT", "SELECT", "TEXTAREA"].includes(target?.tagName);
