// Who saw a cell, when, and by which way that came to the ground: a small panel that asks `/api/provenance`.

import { make, seconds } from "./cards.js";
import { colourOf } from "./map.js";

const DEADLINE_MS = 4000; // the server gives its flight loop two seconds
const CERTAIN = 8;
const WAYS = {
  "own scan": () => "own scan",
  scan: (s) => `scan of D${s.source}, ahead of its tile`,
  tile: (s) => `tile from D${s.source} itself`,
  relay: (s) => `tile passed on by D${s.via}`,
};

export class CellPanel {
  constructor(root, onPlace) {
    this.root = root;
    this.onPlace = onPlace; // told the asked cell's centre, and null once the panel is closed
    this.title = root.querySelector("h2");
    this.told = root.querySelector(".told");
    this.asking = null;
    root.querySelector("button").addEventListener("click", () => this.close());
  }

  toggle(x, y, cell) {
    if (this.root.hidden) this.ask((Math.floor(x / cell) + 0.5) * cell, (Math.floor(y / cell) + 0.5) * cell);
    else this.close();
  }

  close() {
    this.asking?.abort();
    this.asking = null;
    if (this.root.hidden) return;
    this.root.hidden = true;
    this.onPlace(null);
  }

  async ask(x, y) {
    const asking = this.asking = new AbortController();
    this.root.hidden = false;
    this.onPlace([x, y]);
    this.title.textContent = `x ${x.toFixed(2)} m   y ${y.toFixed(2)} m`;
    this.tell(make("p", { text: "Asking the ground station" }));
    let answer;
    try {
      const signal = AbortSignal.any([asking.signal, AbortSignal.timeout(DEADLINE_MS)]);
      const response = await fetch(`/api/provenance?x=${x.toFixed(3)}&y=${y.toFixed(3)}`, { signal });
      if (!response.ok) throw new Error((await response.text()).trim() || `status ${response.status}`);
      answer = await response.json();
    } catch (error) {
      if (this.asking !== asking) return; // closed meanwhile: nobody waits
      const why = error.name === "TimeoutError" ? `no answer within ${DEADLINE_MS / 1000} s`
        : error instanceof TypeError ? "it cannot be reached" : error.message;
      this.tell(make("p", { class: "failed", text: `The ground station did not answer: ${why}.` }));
      return;
    }
    if (this.asking === asking) this.show(answer);
  }

  show(cell) {
    const { belief, sightings } = cell;
    const word = belief < 0 ? "Free" : belief > 0 ? "Occupied" : sightings.length ? "Undecided" : "Unknown";
    const sum = sightings.length ? `, ${units(belief)} of ±${CERTAIN}` : ": nobody has seen it";
    this.tell(make("p", { text: word + sum }), ...(sightings.length ? [make("ul", {}, ...sightings.map(row))] : []));
  }

  tell(...nodes) { this.told.replaceChildren(...nodes); }
}

const units = (n) => (n > 0 ? `+${n}` : n < 0 ? `−${-n}` : "0");

function row(s) {
  const swatch = make("span", { class: "swatch", "aria-hidden": "true" });
  swatch.style.setProperty("--drone", colourOf(s.source));
  const age = s.age_s === null ? "age unknown" : `${seconds(s.age_s)} ago`;
  return make("li", { "data-source": s.source, "data-way": s.way },
    swatch, make("span", { text: `Drone ${s.source} says ${units(s.units)}` }), make("time", { text: age }),
    make("small", { text: (WAYS[s.way]?.(s) ?? s.way) + (s.provisional && s.way !== "scan" ? ", newer scans drawn over it" : "") }));
}
