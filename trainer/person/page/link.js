// The WebSocket: sends the input, receives views and echoes, and reconnects after a loss.

import { OFF } from "./hands.js";

const HEARTBEAT_MS = 100;
const LEAST_MS = 1000 / 60; // between two inputs
const SILENCE_MS = 500; // the trainer counts this as letting go, and so does the page
const RETRY_MS = 500;
const GONE_MS = 2000; // a socket silent for this long is replaced

export class Link {
  // hands: now() returns the input; on: the callbacks {view, echo, state}.
  constructor(hands, on) {
    this.hands = hands;
    this.on = on;
    this.wishes = [];
    this.seen = 0;
    this.saidMs = 0;
    this.saidEngaged = false;
    this.trips = [];
    this.over = false;
    this.opened = false;
    this.open();
    setInterval(() => this.beat(), LEAST_MS);
  }

  open() {
    const url = new URL("socket", location.href);
    url.protocol = "ws:";
    clearTimeout(this.retry); // one connection at a time: `beat` may have opened one
    this.socket = new WebSocket(url);
    this.heardMs = performance.now();
    this.socket.onopen = () => {
      this.seen = 0;
      this.wishes = []; // pressed while disconnected
      this.opened ? this.say() : this.greet();
      this.opened = true;
    };
    this.socket.onmessage = (event) => this.hear(JSON.parse(event.data));
    this.socket.onclose = () => {
      this.on.state(this.over ? "over" : "lost");
      if (!this.over) this.retry = setTimeout(() => this.open(), RETRY_MS);
    };
  }

  // Ignore the old socket from now on: closing it waits for an answer that will not come.
  abandon() {
    this.socket.onopen = this.socket.onmessage = this.socket.onclose = null;
    this.socket.close();
    this.open();
  }

  hear(message) {
    const now = performance.now();
    this.heardMs = now;
    if (message.kind === "echo") {
      this.trips.push(now - message.at_ms);
      if (this.trips.length > 20) this.trips.shift();
      this.on.state("live");
      this.on.echo(message);
    } else if (message.kind === "view") {
      this.on.view(message);
    } else {
      this.over = true;
    }
  }

  // Acknowledge a view; the trainer then sends the next one.
  drew(number) {
    this.seen = number;
    this.changed();
  }

  wish(word) {
    this.wishes.push(word);
    this.changed();
  }

  // The input changed: send it now, or once the limit of 60 a second allows. Taking over, letting
  // go and each place of a wheel, which is read no more often, are sent at once.
  changed() {
    this.dirty = true;
    const { engaged, by_moving } = this.hands.now();
    if (by_moving || engaged !== this.saidEngaged || performance.now() - this.saidMs >= LEAST_MS) this.say();
  }

  beat() {
    const now = performance.now();
    const silentMs = now - this.heardMs;
    if (silentMs > SILENCE_MS && !this.over) this.on.state("lost");
    if (silentMs > GONE_MS && !this.over) this.abandon();
    if (this.dirty || now - this.saidMs >= HEARTBEAT_MS) this.say();
  }

  // A hold counts only after hands off. A hold when the page first connects counts;
  // after a lost connection the hands themselves must let go.
  greet() {
    this.send(OFF);
    this.dirty = true;
  }

  say() {
    this.send(this.hands.now());
  }

  send({ action, engaged, by_moving }) {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    this.saidMs = performance.now();
    this.saidEngaged = engaged;
    this.dirty = false;
    const wishes = [...new Set(this.wishes)];
    this.wishes = [];
    const said = { at_ms: this.saidMs, action, engaged, by_moving, wishes, seen: this.seen };
    this.socket.send(JSON.stringify(said));
  }

  // The median of the last 20, ms.
  tripMs() {
    const sorted = [...this.trips].sort((a, b) => a - b);
    return sorted.length ? sorted[sorted.length >> 1] : NaN;
  }
}
