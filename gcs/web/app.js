// Wires the websocket, the map, the cards and the commands together.

import { Link } from "./link.js";
import { MapView } from "./map.js";
import { Panel, bytes, clock } from "./cards.js";
import { CellPanel } from "./cell.js";

const byId = (id) => document.getElementById(id);
const QUESTIONS = {
  hold: { title: "Hold all drones?", text: (n) => `${n} will stop where they are and hover until you press Resume.`, yes: "Hold all", kind: "caution" },
  land: { title: "Land all drones?", text: (n) => `${n} will descend and land where they are now. The exploration ends.`, yes: "Land all", kind: "danger" },
};
const DOING = { hold: "hold", land: "land", resume: "go on exploring" };
const STALLED_S = 3;

let state = null;
let phase = "connecting";

const map = new MapView(byId("map"), showView);
const panel = new Panel(byId("cards"), byId("events"), (id) => { map.setFollow(map.follow === id ? null : id); refresh(); });
const cell = new CellPanel(byId("cell"), (at) => map.setPicked(at));
map.onPick = (x, y) => cell.toggle(x, y, map.cell);
const link = new Link({ onState, onAnswer, onChange });

// what tests and scripts may rely on
window.imagineState = { connection: phase, knownCells: 0, coverage: null, drones: {}, command: null };

function onState(next, first) {
  if (first) map.reset(); // a new connection starts from an empty map and gets everything
  state = next;
  if (!next) { panel.clear(); cell.close(); map.draw(); refresh(); return; } // it runs, but has nothing to show yet
  map.update(next);
  panel.addEvents(next.events, first);
  refresh();
}

function onChange(next) {
  if (next === phase) return;
  phase = next;
  refresh();
}

function onAnswer(answer) {
  if (answer.refused) notice(`The ground station refused: ${answer.refused}`, "error");
}

// -- showing ----------------------------------------------------------------------------------------------------------

function refresh() {
  const offline = phase !== "live";
  const over = state?.over ?? ""; // the flight has ended: what is shown is final, whether the server still runs or not
  const stalled = !offline && !over && state && state.published_age_s > STALLED_S;
  const quiet = offline ? link.quietSeconds : 0;
  for (const button of document.querySelectorAll(".commands button")) button.disabled = offline || !state?.drones.length;
  document.body.dataset.connection = over ? "over" : phase;
  byId("connection").dataset.state = over ? "over" : offline ? phase : stalled ? "stalled" : "live";
  setText("connection-text", over ? "Flight over" : { connecting: "Connecting", live: stalled ? "Stalled" : "Connected", lost: "Disconnected" }[phase]);
  banner(over ? over : phase === "lost"
    ? `Connection to the ground station lost${state ? `. What you see is ${Math.round(quiet)} s old` : ""}. Trying again.`
    : stalled ? `The ground station answers, but its flight loop has given nothing new for ${Math.round(state.published_age_s)} s.` : "");
  byId("empty").hidden = Boolean(state?.drones.length);
  if (!state) return;
  const extra = over ? 0 : quiet + (stalled ? state.published_age_s : 0);
  const why = over ? "" : offline ? "No connection to the ground station: these are the last figures."
    : stalled ? "The ground station's flight loop is silent: these are the last figures." : "";
  panel.update(state, why, extra, map.follow);
  showFigures(offline);
  showCommand();
  window.imagineState = {
    connection: phase, knownCells: state.map.known_cells, coverage: state.coverage, command: state.command,
    drones: Object.fromEntries(state.drones.map((d) => [d.id, { x: d.x, y: d.y, yaw: d.yaw, stale: d.stale, lost: d.lost, state: d.state, ageS: d.age_s }])),
    trailPoints: Object.fromEntries([...map.trails].map(([id, points]) => [id, points.length])),
    tiles: map.tiles.size,
  };
}

function showFigures(offline) {
  const known = state.coverage === null;
  setText("coverage-label", known ? "Explored" : "Coverage");
  setText("coverage", known ? `${state.known_free_m2.toFixed(1)} m²` : `${(100 * state.coverage).toFixed(1)}%`);
  byId("coverage-bar").hidden = known;
  byId("coverage-bar").value = state.coverage ?? 0;
  setText("elapsed", clock(state.elapsed_s));
  setText("flying", `${state.flying} of ${state.drones.length}`);
  const rate = state.drones.reduce((sum, d) => sum + (d.stale ? 0 : d.rate_bps), 0);
  setText("radio", offline ? "–" : `${bytes(rate)}/s`);
  const silent = state.drones.filter((d) => d.stale).length;
  setText("drone-count", silent ? `${state.drones.length}, ${silent} silent` : String(state.drones.length));
}

function showCommand() {
  const c = state.command;
  if (!c) { if (byId("notice").dataset.kind !== "error") notice(""); return; }
  const whom = c.target ? `Drone ${c.target}` : "All drones";
  const missing = c.expected.filter((id) => !c.confirmed.includes(id));
  if (missing.length) notice(`${whom} told to ${DOING[c.action]}: ${c.confirmed.length} of ${c.expected.length} confirmed, waiting for ${missing.map((i) => `D${i}`).join(", ")}`, "waiting");
  else {
    const gone = state.drones.filter((d) => d.lost && (!c.target || d.id === c.target)).map((d) => `D${d.id}`).join(", ");
    notice(`${whom} told to ${DOING[c.action]}: confirmed by all${gone ? ` that are heard; ${gone} lost` : ""}`, gone ? "waiting" : "done");
  }
}

function setText(id, text) { const node = byId(id); if (node.textContent !== text) node.textContent = text; }

function banner(text) { byId("banner").hidden = !text; setText("banner", text); }

let errorTimer = 0;
function notice(text, kind = "") {
  const node = byId("notice");
  if (kind === "error") { clearTimeout(errorTimer); errorTimer = setTimeout(() => { node.dataset.kind = ""; notice(""); }, 6000); }
  else if (node.dataset.kind === "error") return;
  node.hidden = !text;
  node.dataset.kind = kind;
  setText("notice", text);
}

function showView() {
  const target = [50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1].find((m) => m * map.view.scale <= 140) ?? 0.1;
  byId("scale-bar").style.width = `${Math.round(target * map.view.scale)}px`;
  setText("scale-text", target < 1 ? `${target * 100} cm` : `${target} m`);
  setText("cursor", map.cursor ? `x ${map.cursor[0].toFixed(2)} m   y ${map.cursor[1].toFixed(2)} m` : "");
  byId("fit").setAttribute("aria-pressed", String(map.auto));
}

// -- commands ---------------------------------------------------------------------------------------------------------

const dialog = byId("confirm");
let asked = null;

function ask(verb) {
  const question = QUESTIONS[verb];
  if (!question) { send(verb); return; }
  asked = verb;
  const n = state?.drones.length ?? 0;
  byId("confirm-title").textContent = question.title;
  byId("confirm-text").textContent = question.text(n === 1 ? "The drone" : `All ${n} drones`);
  const yes = byId("confirm-yes");
  yes.textContent = question.yes;
  yes.className = question.kind;
  dialog.returnValue = "";
  dialog.showModal();
}

function send(verb) {
  if (!link.send(verb)) notice("Not sent: no connection to the ground station", "error");
}

dialog.addEventListener("close", () => { if (dialog.returnValue === "yes" && asked) send(asked); asked = null; });
document.addEventListener("keydown", (e) => { if (e.key === "Escape" && !dialog.open) cell.close(); });
for (const button of document.querySelectorAll("[data-verb]")) button.addEventListener("click", () => ask(button.dataset.verb));
byId("zoom-in").addEventListener("click", () => map.zoom(1.25));
byId("zoom-out").addEventListener("click", () => map.zoom(0.8));
byId("fit").addEventListener("click", () => { map.setAuto(true); refresh(); });
setInterval(() => { if (phase !== "live") refresh(); }, 500); // ages go on while nothing arrives
