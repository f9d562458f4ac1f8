// The panels beside an arena: what crashes cost, what robots wanted and did, events, the coach.

import { modeColour } from "./colours.js";
import { make, shortName } from "./dom.js";

const MOST_EVENTS = 60;
const WITHHELD = -1;
const SHOWN_STEPS = 24;
const SHOWN_ROBOTS = 6;

const percent = (share) => `${Math.round(100 * share)} %`;

/** rows: as Costs.rows gives them. */
export function showCosts(place, rows) {
  if (!rows.length) {
    place.replaceChildren(make("p", { class: "hint", text: "Once an episode has ended." }));
    return;
  }
  const head = make("tr", {}, ["crashed", "episodes", "success (95 %)", "return"].map((text) => {
    return make("th", { scope: "col", text });
  }));
  const table = make("table", {}, [
    make("thead", {}, [head]), make("tbody", {}, rows.map(costRow)),
  ]);
  place.replaceChildren(table);
}

function who({ crashed, modes }) {
  if (crashed === null) return "all episodes";
  if (typeof crashed === "number") return `${crashed} robots`;
  return crashed.length ? `${crashed.join(", ")}: ${modes.join(", ")}` : "nobody";
}

function costRow(row) {
  const [rate, low, high] = row.success;
  const band = row.alike ? [] : [
    make("i", { style: `left:${100 * low}%;width:${100 * (high - low)}%` }),
  ];
  const bar = make("span", { class: "interval", "aria-hidden": "true" }, [
    ...band,
    make("b", { style: `left:${100 * rate}%` }),
  ]);
  const range = row.alike ? "all ended alike" : `${Math.round(100 * low)}–${Math.round(100 * high)}`;
  const [mean, from, to] = row.return;
  const spread = from === null ? "" : ` ± ${((to - from) / 2).toFixed(2)}`;
  return make("tr", {}, [
    make("th", { scope: "row", text: who(row) }),
    make("td", { text: row.episodes }),
    make("td", {}, [
      bar, make("span", { text: `${percent(rate)} (${range})` }),
    ]),
    make("td", { text: `${mean.toFixed(2)}${spread}` }),
  ]);
}

/** The last steps of the selected robots, or of those in a fault, or of the first ones. */
export function showSteps(place, team, arena, selected, modes) {
  const chosen = team.robots.filter((robot) => selected.has(robot.name));
  const faulted = team.robots.filter((robot) => robot.mode);
  const shown = (chosen.length ? chosen : faulted.length ? faulted : team.robots);
  const names = arena?.action_names ?? [];
  place.replaceChildren(...shown.slice(0, SHOWN_ROBOTS).map((robot) => {
    const cells = robot.steps.slice(-SHOWN_STEPS).map((step) => stepCell(step, names, modes));
    return make("div", { class: "strip" }, [
      make("span", { class: "name", text: robot.name }),
      make("span", { class: "cells" }, cells),
    ]);
  }));
  if (!place.childElementCount) {
    place.replaceChildren(make("p", { class: "hint", text: "Once a robot has acted." }));
  }
}

function stepCell([episode, step, intent, applied, mode], names, modes) {
  const called = (action) => names[action] ?? (action < 0 ? "?" : String(action));
  const done = { [WITHHELD]: "withheld", "-2": "sensed otherwise", "-3": "relayed" }[applied]
    ?? called(applied);
  const wanted = intent < 0 ? "" : `wanted ${called(intent)}, `;
  const title = `episode ${episode}, step ${step}: ${wanted}${mode ? `${mode}: ` : "did "}${done}`;
  const mark = applied === WITHHELD ? "–" : applied < 0 ? "~" : brief(called(applied));
  const cell = make("abbr", { title, class: mode ? "cell faulted" : "cell" }, [
    make("s", { text: mode && intent >= 0 ? brief(called(intent)) : "" }),
    make("span", { text: mark }),
  ]);
  if (mode) cell.style.setProperty("--mode", modeColour(modes, mode));
  return cell;
}

const ARROWS = { north: "↑", south: "↓", east: "→", west: "←", up: "↑", down: "↓", stay: "·",
  stop: "·", stand: "·", left: "←", right: "→", no_op: "∅", "no-op": "∅", noop: "∅" };

function brief(name) {
  const last = name.replace(/^move_/, "");
  return ARROWS[last] ?? (/\d+$/.test(name) ? `⚔${shortName(name)}` : last.slice(0, 2));
}

/** entries: the newest, oldest first; put before those that are there. */
export function showEvents(list, entries) {
  for (const entry of entries.slice(-MOST_EVENTS)) list.prepend(eventLine(entry));
  while (list.childElementCount > MOST_EVENTS) list.lastElementChild.remove();
}

function eventLine(entry) {
  const time = new Date(1000 * entry.at_s).toLocaleTimeString([], { hour12: false });
  const what = [entry.robot, entry.mode, entry.detail].filter(Boolean).join(" · ");
  const where = entry.step === null ? `episode ${entry.episode}`
    : `episode ${entry.episode}, step ${entry.step}`;
  return make("li", { "data-kind": entry.kind }, [
    make("time", { text: time }),
    make("strong", { text: entry.kind }),
    make("span", { text: what ? `${what} · ${where}` : where }),
  ]);
}

const FIRST = ["enabled", "strategy", "crash_rate", "crash_mode", "victims", "apply_at",
  "start_step", "duration_steps", "max_crashed", "lease_s", "seed"];

/** The coach's parameters, the important ones first, and the rate of its plan. */
export function showCoach(place, settings, team) {
  const names = Object.keys(settings).sort((a, b) => rank(a) - rank(b));
  const rate = team.rate === null ? [] : [["crash rate α now", team.rate]];
  const rows = [...rate, ...names.map((name) => [name, settings[name]])];
  const open = place.querySelector("details")?.open ?? false;
  const lines = rows.map(([name, value]) => [
    make("dt", { text: name }), make("dd", { text: String(value) || "–" }),
  ]);
  const head = rate.length + FIRST.length;
  place.replaceChildren(
    make("dl", {}, lines.slice(0, head).flat()),
    make("details", { open }, [
      make("summary", { text: "All parameters" }), make("dl", {}, lines.slice(head).flat()),
    ]),
  );
}

function rank(name) {
  const index = FIRST.indexOf(name);
  return index < 0 ? FIRST.length : index;
}
