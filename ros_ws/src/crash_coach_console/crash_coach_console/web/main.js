// The page: connection, stages, keys.

import { isDark } from "./colours.js";
import { make, setText } from "./dom.js";
import { Faults } from "./faults.js";
import { Link } from "./link.js";
import { Stage } from "./stage.js";

const CONNECTION = { open: "connected", lost: "console gone, trying again", waiting: "connecting" };

class Page {
  constructor() {
    /** @type {Stage[]} */
    this.stages = [];
    this.faults = new Faults(this);
    this.keys = new Map();
    this.defineKeys();
    this.link = new Link((message) => this.take(message), (state) => this.showConnection(state));
    const frame = (now) => {
      for (const stage of this.stages) stage.draw(now);
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  take(message) {
    if (message.type === "hello") this.build(message);
    else this.stages[message.source]?.take(message);
  }

  build(hello) {
    this.stages = hello.sources.map((source, i) => new Stage(i, source, hello.modes, this));
    const place = document.getElementById("stages");
    place.replaceChildren(...this.stages.map((stage) => stage.root));
    document.body.dataset.stages = String(this.stages.length);
    const over = this.stages.every((stage) => stage.kind !== "graph");
    document.body.dataset.over = String(over);
    this.faults.setModes(hello.modes);
    this.faults.setTeams(this.teams());
    document.getElementById("controls").hidden = !this.teams().length;
  }

  showConnection(state) {
    const place = document.getElementById("connection");
    place.dataset.state = state;
    setText(place, CONNECTION[state]);
  }

  /** Stages whose robots can be crashed. */
  teams() {
    return this.stages.filter((stage) => stage.crashable);
  }

  teamChanged() {
    this.faults.setTeams(this.teams());
    this.faults.refresh();
  }

  selectedNames() {
    const names = new Set(this.teams().flatMap((stage) => [...stage.selected]));
    return [...names];
  }

  /** Whether a robot is crashed, or is to be. */
  isVictim(name) {
    return this.teams().some((stage) => {
      const robot = stage.robot(name);
      return robot && (robot.state === "faulted" || robot.planned.length > 0);
    });
  }

  toggle(stage, name) {
    const names = new Set(stage.selected);
    if (!names.delete(name)) names.add(name);
    this.selectEverywhere([...names]);
  }

  /** The same robots in every team: they are crashed alike. */
  selectEverywhere(names) {
    for (const stage of this.stages) stage.select(names);
    this.faults.refresh();
  }

  crash(stage, name) {
    if (!stage.crashable) return;
    this.selectEverywhere([name]);
    this.faults.crash([name]);
  }

  async ask(stage, type, fields) {
    const answer = await this.link.ask(stage.number, type, fields);
    this.faults.say(answer.text, answer.ok ? "ok" : "bad");
  }

  askAll(type, fields) {
    for (const stage of this.stages) this.ask(stage, type, fields?.(stage));
  }

  redraw() {
    for (const stage of this.stages) stage.dirty = true;
  }

  turnTheme() {
    document.documentElement.dataset.theme = isDark() ? "light" : "dark";
    this.redraw();
  }

  // --- keys ---------------------------------------------------------------------------------------

  defineKeys() {
    const names = () => this.teams()[0]?.team.robots.map((robot) => robot.name) ?? [];
    const define = (key, shown, what, act) => this.keys.set(key, { shown, what, act });
    for (let k = 1; k <= 9; k += 1) {
      define(String(k), k === 1 ? "1 … 9" : "", "select a robot, or not", () => {
        const name = names()[k - 1];
        if (name) this.toggle(this.teams()[0], name);
      });
    }
    define("a", "a", "select all robots", () => this.selectEverywhere(names()));
    define("Escape", "Esc", "select none", () => this.selectEverywhere([]));
    define("x", "x", "crash the selected robots", () => this.faults.crash());
    define("m", "m", "the next fault", () => this.faults.nextMode());
    define("c", "c", "clear the selected robots", () => this.faults.clear());
    define("C", "Shift c", "clear all", () => this.faults.clearAll());
    define(" ", "space", "pause, or go on", () => {
      this.askAll("pause", (stage) => ({ on: !stage.paused() }));
    });
    define(".", ".", "one step while paused", () => this.askAll("step"));
    define(",", ",", "one step back, of what is over", () => {
      for (const stage of this.stages) {
        if (stage.kind !== "graph") this.ask(stage, "step", { by: -1 });
      }
    });
    define("r", "r", "the next episode", () => this.askAll("reset"));
    define("t", "t", "dark or light", () => this.turnTheme());
    define("?", "?", "these keys", () => this.showHelp());
    document.addEventListener("keydown", (event) => this.onKey(event));
    document.getElementById("theme").addEventListener("click", () => this.turnTheme());
    document.getElementById("help-open").addEventListener("click", () => this.showHelp());
  }

  onKey(event) {
    const target = /** @type {HTMLElement} */ (event.target);
    const typing = target.closest("input, select, textarea, dialog");
    const pressing = target.closest("button, summary") && [" ", "Enter"].includes(event.key);
    if (typing || pressing || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = this.keys.get(event.key);
    if (!key) return;
    event.preventDefault();
    key.act();
  }

  showHelp() {
    const lines = [...this.keys.values()].filter((key) => key.shown);
    document.getElementById("keys").replaceChildren(...lines.flatMap((key) => [
      make("dt", { text: key.shown }), make("dd", { text: key.what }),
    ]));
    /** @type {HTMLDialogElement} */ (document.getElementById("help")).showModal();
  }
}

// For tests, and for the curious at the browser's console.
Object.assign(globalThis, { crashCoach: new Page() });
