// The side panel: one card a drone, and the list of events.

import { colourOf } from "./map.js";

const STATES = {
  idle: ["○", "On ground"], policy: ["▶", "Exploring"], frontier: ["▷", "Exploring, rescue"], hold: ["❚❚", "Holding"],
  land: ["▼", "Landing"], disarm: ["■", "Disarmed"],
};
const EXPLAIN = {
  idle: "Waiting for takeoff", policy: "The policy decides", frontier: "Flies to the nearest frontier through the known map",
  hold: "Hovers in place", land: "Descends to land", disarm: "Motors off",
};
const KINDS = ["scan", "tile", "digest", "status"];
const PLACES = {
  candidate: ["◎", "Being placed", "Its map seems to fit in one place; later evidence must bear that out before it is shown."],
  unknown: ["◌", "Not placed", "Nobody knows yet where its map lies in this one: it is not shown."],
};
const EVENT_LIMIT = 200;

export const bytes = (n) => (n < 1000 ? `${Math.round(n)} B` : n < 1e6 ? `${(n / 1e3).toFixed(1)} kB` : `${(n / 1e6).toFixed(2)} MB`);
export const clock = (s) => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;
const area = (cells, cell) => `${(cells * cell * cell).toFixed(1)} m²`;
const grouped = (n) => String(n).replace(/\B(?=(\d{3})+$)/g, "\u202f");
export const seconds = (s) => (s < 60 ? `${s.toFixed(1)} s` : clock(s));

export function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) name === "text" ? (node.textContent = value) : node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// only changed text is written, so that screen readers and selections are left in peace
function write(node, text) { if (node.textContent !== text) node.textContent = text; }
function mark(node, name, value) { if (node.getAttribute(name) !== String(value)) node.setAttribute(name, value); }

function taught(d) {
  const cells = (d.taught.scan ?? 0) + (d.taught.tile ?? 0), spent = (d.bytes_sent.scan ?? 0) + (d.bytes_sent.tile ?? 0);
  return spent ? `${grouped(cells)} cells, ${(cells / spent).toFixed(1)} a byte` : "nothing yet";
}

class Card {
  constructor(id, onFollow) {
    const field = (key, label, wide = false) => {
      const value = make("dd", { "data-testid": `drone-${id}-${key}` });
      this[key] = value;
      return make("div", wide ? { class: "wide" } : {}, make("dt", { text: label }), value);
    };
    const swatch = make("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.setProperty("--drone", colourOf(id));
    this.glyph = make("span", { class: "glyph", "aria-hidden": "true" });
    this.state = make("span", { "data-testid": `drone-${id}-state` });
    this.badge = make("span", { class: "badge" }, this.glyph, this.state);
    this.placeGlyph = make("span", { class: "glyph", "aria-hidden": "true" });
    this.placeText = make("span", { "data-testid": `drone-${id}-place` });
    this.place = make("p", { class: "placing", hidden: "" }, make("span", { class: "badge place" }, this.placeGlyph, this.placeText));
    this.follow = make("button", { type: "button", class: "quiet", "aria-pressed": "false", "aria-label": `Follow drone ${id} on the map`, text: "Follow" });
    this.follow.addEventListener("click", () => onFollow(id));
    this.reason = make("p", { class: "reason", "data-testid": `drone-${id}-reason` });
    this.note = make("p", { class: "note", "data-testid": `drone-${id}-note`, hidden: "" });
    this.fill = make("i");
    this.level = make("span", { class: "level", "aria-hidden": "true" }, this.fill);
    this.charge = make("span", { "data-testid": `drone-${id}-battery` });
    this.kinds = make("dd", { class: "kinds" });
    this.root = make("article", { "data-testid": `drone-card-${id}`, "aria-label": `Drone ${id}` },
      make("header", {}, swatch, make("h3", { text: `Drone ${id}` }), this.badge, this.follow),
      this.place, this.reason, this.note,
      make("dl", {},
        make("div", {}, make("dt", { text: "Battery" }), make("dd", { class: "battery" }, this.level, this.charge)),
        field("height", "Height"), field("speed", "Speed"), field("age", "Data age"),
        field("mode", "Mode", true), field("cells", "Own area"), field("hears", "Hears"),
        field("radio", "Sent"), field("rate", "Rate"), field("taught", "Taught its peers", true),
        make("div", { class: "wide" }, make("dt", { text: "Sent by kind" }), this.kinds)));
    this.id = id;
  }

  update(d, cell, offline, quiet) {
    const age = d.age_s + quiet, stale = d.stale || Boolean(offline);
    mark(this.root, "data-stale", stale);
    mark(this.root, "data-state", d.lost ? "lost" : stale ? "stale" : d.state);
    const [glyph, word] = d.lost ? ["✕", "Lost"] : stale ? ["!", "No data"] : STATES[d.state] ?? ["?", d.state];
    write(this.glyph, glyph);
    write(this.state, word);
    const last = (STATES[d.state] ?? ["", d.state])[1].toLowerCase();
    const silent = d.stale ? `Not heard for ${Math.round(age)} s. It was last ${last}${d.reason ? `: ${d.reason}` : ""}.`
      : offline || null;
    write(this.reason, silent ?? (d.reason || EXPLAIN[d.state] || ""));
    const unplaced = PLACES[d.place];
    this.place.hidden = !unplaced;
    if (unplaced) { write(this.placeGlyph, unplaced[0]); write(this.placeText, unplaced[1]); mark(this.place, "title", unplaced[2]); }
    write(this.taught, taught(d));
    mark(this.taught, "title", `${d.taught.scan ?? 0} cells by scans, ${d.taught.tile ?? 0} by tiles, for each byte of scans and tiles sent`);
    write(this.note, d.note);
    this.note.hidden = !d.note;
    write(this.charge, d.battery === null ? "unknown" : `${Math.round(d.battery * 100)}%${d.battery <= 0.2 ? " low" : ""}`);
    this.level.hidden = d.battery === null;
    this.fill.style.width = `${Math.round((d.battery ?? 0) * 100)}%`;
    mark(this.level, "data-low", d.battery !== null && d.battery <= 0.2);
    write(this.mode, `${d.mode || "unknown"}, ${d.armed ? "armed" : "disarmed"}`);
    write(this.age, seconds(age));
    write(this.height, `${d.height_m.toFixed(1)} m`);
    write(this.speed, `${Math.hypot(d.vx, d.vy).toFixed(2)} m/s`);
    write(this.cells, area(d.own_cells, cell));
    mark(this.cells, "title", `${d.own_cells} cells seen itself, ${d.scan_cells} from peers' scans, ${d.map_cells} in its map`);
    write(this.radio, bytes(Object.values(d.bytes_sent).reduce((a, b) => a + b, 0)));
    write(this.rate, `${bytes(stale ? 0 : d.rate_bps)}/s`);
    write(this.hears, d.hears.length && !stale ? d.hears.map((i) => `D${i}`).join(", ") : "nobody");
    const kinds = [...KINDS.filter((k) => k in d.bytes_sent), ...Object.keys(d.bytes_sent).filter((k) => !KINDS.includes(k))];
    write(this.kinds, kinds.map((k) => `${k} ${bytes(d.bytes_sent[k]).replace(" ", "\u00a0")}`).join(", ") || "nothing yet");
    if (d.stale && !this.wasStale) this.root.scrollIntoView({ block: "nearest" });
    this.wasStale = d.stale;
  }
}

export class Panel {
  constructor(container, events, onFollow) {
    this.container = container;
    this.events = events;
    this.onFollow = onFollow;
    this.cards = new Map();
  }

  clear() {
    for (const card of this.cards.values()) card.root.remove();
    this.cards.clear();
    this.events.replaceChildren();
  }

  // `offline` says why nothing new comes, or is empty
  update(state, offline, quiet, followed) {
    const present = new Set(state.drones.map((d) => d.id));
    for (const [id, card] of this.cards) if (!present.has(id)) { card.root.remove(); this.cards.delete(id); }
    for (const d of state.drones) {
      let card = this.cards.get(d.id);
      if (!card) {
        card = new Card(d.id, this.onFollow);
        this.cards.set(d.id, card);
        const next = [...this.cards.values()].filter((c) => c.id > d.id).sort((a, b) => a.id - b.id)[0];
        this.container.insertBefore(card.root, next?.root ?? null);
      }
      card.update(d, state.map.cell_m, offline, quiet);
      mark(card.follow, "aria-pressed", d.id === followed);
    }
  }

  addEvents(events, fresh) {
    if (fresh) this.events.replaceChildren();
    for (const e of events) {
      const sign = { error: "✕", warning: "!", info: "·" }[e.severity] ?? "·";
      const who = e.drone ? `D${e.drone}` : "all";
      this.events.prepend(make("li", { "data-severity": e.severity }, make("time", { text: clock(e.time_s) }),
        make("span", { class: "glyph", "aria-hidden": "true", text: sign }), make("b", { text: who }), make("span", { text: e.text })));
    }
    while (this.events.children.length > EVENT_LIMIT) this.events.lastChild.remove();
  }
}
