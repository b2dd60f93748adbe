// The browser's Gamepad API: any axis, pedal or trigger as the action, any button as the hold.
//
// The action is the plus input less the minus input. A stick or a wheel has both in one axis; a
// pair of pedals is two inputs.

import { list, mix, OFF, shares, ways } from "./hands.js";

const KEPT = "phil-cockpit-gamepad"; // in localStorage, by device and scenario
const WHEEL = /wheel|racing|driving force|\b[gt]\d{2,3}\b/i; // in the device's name
const WISHES = { 8: "restart", 9: "pause" }; // back or share, start or options: of most gamepads, and of a G29
const MOVING = "moving"; // instead of a button: moving the wheel takes over, letting it rest hands control back

// The choices, and the property of the form's control that holds each.
export const FIELDS = {
  plus: "value", minus: "value", dead: "valueAsNumber", full: "valueAsNumber", invert: "checked",
  hold: "value",
};

const SOURCES = {
  axis: (pad, index) => pad.axes[index] ?? 0,
  // A pedal is an axis that rests at 1 and is -1 when pressed down. Until it has moved, browsers
  // report 0 for it.
  pedal: (pad, index) => (pad.axes[index] ? (1 - pad.axes[index]) / 2 : 0),
  button: (pad, index) => pad.buttons[index]?.value ?? 0,
};

export function preset(pad, upright) {
  const common = { dead: 0.05, full: 1, invert: false, hold: "button 5" };
  if (pad.mapping === "standard") {
    return upright
      ? { ...common, plus: "button 7", minus: "button 6" }
      : { ...common, plus: "axis 0", minus: "", dead: 0.15 };
  }
  // A wheel: axis 0 turns, the next ones are pedals (a G29's throttle and brake). The trigger of a
  // gamepad that the browser does not know may rest at the end of an axis: no move takes over.
  const hold = WHEEL.test(pad.id) ? MOVING : common.hold;
  return upright
    ? { ...common, plus: "pedal 2", minus: "pedal 3", hold }
    : { ...common, plus: "axis 0", minus: "", dead: 0.02, full: 0.25, hold };
}

export function read(pad, choice) {
  const { plus, minus, dead, full, invert, hold } = choice;
  const raw = ((value(pad, plus) - value(pad, minus)) * (invert ? -1 : 1)) / full;
  const size = Math.max(0, Math.abs(raw) - dead) / (1 - dead); // no jump at the zone's edge
  const action = Math.sign(raw) * Math.min(size, 1);
  const by_moving = hold === MOVING;
  return { action, engaged: !by_moving && value(pad, hold) > 0.5, by_moving };
}

function value(pad, source) {
  const [kind, index] = source.split(" ");
  return kind in SOURCES ? SOURCES[kind](pad, Number(index)) : 0;
}

export class Gamepads {
  // form: the selects and inputs by name.
  constructor(form, changed, wish) {
    this.form = form;
    this.changed = changed;
    this.wish = wish;
    this.down = {}; // number of a button -> whether it was pressed; empty for a new device
    this.scenario = this.controls = null;
    this.pad = null;
    this.said = OFF;
    for (const name in FIELDS) {
      form[name].addEventListener("input", () => this.choose());
      form[name].addEventListener("change", () => form[name].blur()); // the arrow keys drive again
    }
  }

  // Read the device, about 60 times a second.
  step() {
    if (!this.scenario) return;
    // Absent where the page came over plain http from another machine.
    const pads = [...(navigator.getGamepads?.() ?? [])].filter((pad) => pad?.connected);
    // The device in use stays in use.
    const pad = pads.find((other) => other.index === this.pad?.index) ?? pads[0] ?? null;
    if (pad?.id !== this.pad?.id || (pad && this.chosenFor !== this.scenario)) this.take(pad);
    this.pad = pad;
    for (const [index, word] of Object.entries(WISHES)) {
      const down = pad?.buttons[index]?.pressed ?? false;
      if (down && this.down[index] === false && this.choice.hold !== `button ${index}`) this.wish(word);
      this.down[index] = down;
    }
    const said = pad ? this.said_by(pad) : OFF;
    const before = this.said;
    this.said = said;
    const was = list(before.action);
    const moved = list(said.action).some((value, i) => Math.abs(value - (was[i] ?? 0)) > 0.002);
    if (moved || said.engaged !== before.engaged || said.by_moving !== before.by_moving) {
      this.changed();
    }
  }

  // The chosen inputs press left and right, or up and down in an environment without left and
  // right. In one with both, the pedals of the preset press up and down.
  said_by(pad) {
    const said = read(pad, this.choice);
    const { aside, along } = ways(this.controls);
    const several = aside && along && list(this.controls.rest).length > 1;
    const pedals = several ? read(pad, { ...preset(pad, true), hold: this.choice.hold }).action : 0;
    const place = aside ? { aside: said.action, along: pedals } : { along: said.action };
    return { ...said, action: mix(this.controls, shares(place)) };
  }

  now() {
    return this.said;
  }

  take(pad) {
    this.chosenFor = this.scenario;
    this.down = {};
    this.form.name.textContent = pad ? pad.id : "none: press one of its buttons";
    if (!pad) return;
    this.key = `${pad.id} ${this.scenario}`;
    this.choice = { ...preset(pad, !ways(this.controls).aside), ...kept()[this.key] };
    const numbered = (kind, count) => [...Array(count).keys()].map((index) => `${kind} ${index}`);
    const axes = numbered("axis", pad.axes.length);
    const pedals = numbered("pedal", pad.axes.length);
    const buttons = numbered("button", pad.buttons.length);
    options(this.form.plus, ["", ...axes, ...pedals, ...buttons], this.choice.plus);
    options(this.form.minus, ["", ...pedals, ...buttons], this.choice.minus);
    options(this.form.hold, [MOVING, ...buttons], this.choice.hold);
    for (const name of ["dead", "full", "invert"]) this.form[name][FIELDS[name]] = this.choice[name];
  }

  choose() {
    if (!this.pad) return;
    const chosen = Object.entries(FIELDS).map(([name, field]) => [name, this.form[name][field]]);
    this.choice = Object.fromEntries(chosen);
    localStorage.setItem(KEPT, JSON.stringify({ ...kept(), [this.key]: this.choice }));
  }
}

function kept() {
  try {
    return JSON.parse(localStorage.getItem(KEPT)) ?? {};
  } catch {
    return {}; // not ours, or storage is forbidden
  }
}

function options(select, values, chosen) {
  select.replaceChildren(...values.map((text) => new Option(text || "nothing", text)));
  select.value = values.includes(chosen) ? chosen : values[0];
}
