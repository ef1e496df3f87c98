// The websocket to the ground station: reconnects by itself, and notices a connection that has gone quiet.

const RETRY_MS = [500, 1000, 2000, 3000];
const QUIET_MS = 3000;

export class Link {
  // callbacks: onState(state or null, first of this connection), onAnswer(answer), onChange("connecting" | "live" | "lost")
  constructor(callbacks) {
    this.callbacks = callbacks;
    this.tries = 0;
    this.heardAt = performance.now();
    this.open();
    setInterval(() => this.watch(), 250);
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/ws`);
    this.socket = socket;
    this.first = true;
    socket.onopen = () => { this.tries = 0; this.heardAt = performance.now(); };
    socket.onmessage = (event) => {
      if (socket !== this.socket) return;
      const message = JSON.parse(event.data);
      if ("accepted" in message || "refused" in message) { this.callbacks.onAnswer(message); return; }
      this.heardAt = performance.now();
      this.callbacks.onState(message.waiting ? null : message, this.first);
      this.first = false;
      this.callbacks.onChange("live");
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.callbacks.onChange("lost");
      const wait = RETRY_MS[Math.min(this.tries++, RETRY_MS.length - 1)];
      setTimeout(() => { if (socket === this.socket) this.open(); }, wait);
    };
  }

  watch() {
    if (this.socket.readyState !== WebSocket.OPEN || this.first) return;
    if (performance.now() - this.heardAt > QUIET_MS) this.socket.close();
  }

  get quietSeconds() { return (performance.now() - this.heardAt) / 1000; }

  send(verb, target = 0) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify({ command: verb, target }));
    return true;
  }
}
