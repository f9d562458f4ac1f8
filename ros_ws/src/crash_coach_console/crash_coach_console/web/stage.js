// One source on the page: its arena, its robots, its panels.

import * as draw from "./arena.js";
import { modeColour, palette } from "./colours.js";
import { find, make, setText } from "./dom.js";
import { Motion, Trails } from "./motion.js";
import { Curves } from "./curves.js";
import { showCoach, showCosts, showEvents, showSteps } from "./panels.js";
import { Timeline } from "./timeline.js";

const HIT_MS = 350;
const NEAR_PX = 14;
const CAMERA_MS = 900;

export class Stage {
  /**
   * @param {number} number which source it shows
   * @param {{title: string, kind: string}} source
   * @param {any[]} modes
   * @param {any} page what hears of clicks: toggle(stage, name), crash(stage, name), ask(...)
   */
  constructor(number, source, modes, page) {
    this.number = number;
    this.kind = source.kind;
    this.modes = modes;
    this.page = page;
    this.motion = new Motion();
    this.trails = new Trails();
    this.arena = null;
    this.camera = null;
    this.team = { robots: [], rate: null };
    this.status = { alive: {}, ready: false, paused: false };
    this.hits = [];
    this.selected = new Set();
    this.hovered = "";
    this.dirty = true;
    const template = /** @type {HTMLTemplateElement} */ (document.getElementById("stage"));
    const copy = /** @type {DocumentFragment} */ (template.content.cloneNode(true));
    this.root = /** @type {HTMLElement} */ (find(copy, ".stage"));
    this.root.dataset.kind = source.kind;
    this.crashable = source.kind === "graph" || source.kind === "episodes";
    this.canvas = /** @type {HTMLCanvasElement} */ (find(copy, "canvas"));
    this.part = (name) => find(this.root, name);
    setText(this.part(".title"), source.title);
    this.timeline = new Timeline(this.root, modes, (type, fields) => page.ask(this, type, fields));
    this.curves = new Curves(this.part(".curves"));
    this.listen();
    new ResizeObserver(() => this.resize()).observe(this.part(".arena"));
  }

  listen() {
    const act = (name, type, fields) => {
      this.part(name).addEventListener("click", () => this.page.ask(this, type, fields?.()));
    };
    act(".pause", "pause", () => ({ on: !this.paused() }));
    act(".step", "step");
    act(".back", "step", () => ({ by: -1 }));
    act(".reset", "reset");
    act(".forget", "forget");
    this.canvas.addEventListener("click", (event) => {
      const name = this.robotAt(event);
      if (name) this.page.toggle(this, name);
    });
    this.canvas.addEventListener("dblclick", (event) => {
      const name = this.robotAt(event);
      if (name) this.page.crash(this, name);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const name = this.robotAt(event);
      if (name !== this.hovered) {
        this.hovered = name;
        this.canvas.style.cursor = name ? "pointer" : "default";
        this.canvas.title = name ? this.describe(name) : "";
      }
    });
  }

  // --- messages ---------------------------------------------------------------------------------

  take(message) {
    this.dirty = true;
    switch (message.type) {
      case "arena":
        this.arena = message;
        this.camera = null;
        this.trails.clear();
        this.showRobots();
        this.label();
        break;
      case "state":
        this.takeState(message);
        break;
      case "team":
        this.team = message;
        this.showRobots();
        showSteps(this.part(".steps .rows"), this.team, this.arena, this.selected, this.modes);
        this.page.teamChanged();
        break;
      case "status":
        this.status = message;
        this.showStatus();
        this.page.teamChanged();
        break;
      case "costs":
        showCosts(this.part(".costs .rows"), message.rows);
        break;
      case "events":
        showEvents(this.part(".events .rows"), message.entries);
        break;
      case "coach":
        this.settings = message.settings;
        showCoach(this.part(".coach .rows"), message.settings, this.team);
        break;
      case "timeline":
        this.timeline.show(message);
        this.showStatus();
        break;
      case "curves":
        this.curves.show(message);
        break;
      default:
        console.warn(`unknown message ${message.type}`);
    }
  }

  takeState(state) {
    const now = performance.now();
    const before = this.motion.newest;
    if (before && (before.episode !== state.episode || before.step > state.step)) this.hits = [];
    this.motion.push(state, now);
    this.trails.push(state, this.robotIndexes());
    for (let k = 0; k + 1 < state.hits.length; k += 2) {
      this.hits.push({ from: state.hits[k], to: state.hits[k + 1], born: now });
    }
    this.timeline.seen(state.step);
    this.showFacts(state);
    this.showHealth(state);
  }

  robotIndexes() {
    const actors = this.arena?.actors ?? [];
    return actors.flatMap((actor, i) => (actor.side === "robots" ? [i] : []));
  }

  // --- words ------------------------------------------------------------------------------------

  showFacts(state) {
    if (!this.arena?.scenario) {
      setText(this.part(".facts"), `${this.team.robots.length} robots`);
      return;
    }
    const end = state.ended ? (state.success ? " · success" : " · no success") : "";
    setText(this.part(".facts"), `episode ${state.episode} · step ${state.step} · `
      + `${state.time_s.toFixed(1)} s · return ${state.return.toFixed(2)}${end}`);
  }

  /** Whether the sim stands, or the recorded episode. */
  paused() {
    return this.kind === "graph" ? this.status.paused : !this.timeline.playing;
  }

  showStatus() {
    const { alive, title } = this.status;
    const live = this.kind === "graph";
    const paused = live && this.paused();
    if (title) setText(this.part(".title"), title);
    setText(this.part(".pause"), this.paused() ? (live ? "Go on" : "Play") : "Pause");
    const banner = this.part(".banner");
    const silent = live && !alive.sim && !alive.gate;
    banner.hidden = !silent && !paused;
    setText(banner, silent ? "no team on this graph yet" : "paused");
  }

  label() {
    const names = this.team.robots.map((robot) => robot.name).join(", ");
    const scenario = this.arena ? this.arena.scenario : "";
    this.canvas.setAttribute("aria-label", `Arena of ${scenario}: ${names}`);
  }

  describe(name) {
    const robot = this.robot(name);
    if (!robot) return name;
    const state = { ok: "ok", faulted: robot.mode, lost: "lost" }[robot.state] ?? robot.state;
    return `${name}: ${state}${robot.words ? ` (${robot.words})` : ""}`;
  }

  robot(name) {
    return this.team.robots.find((robot) => robot.name === name);
  }

  showRobots() {
    const list = this.part(".robots");
    const names = this.team.robots.map((robot) => robot.name);
    if (list.dataset.names !== names.join()) {
      list.dataset.names = names.join();
      list.replaceChildren(...names.map((name) => this.makeChip(name)));
      this.label();
    }
    this.team.robots.forEach((robot, i) => {
      const chip = /** @type {HTMLElement} */ (list.children[i].firstElementChild);
      chip.dataset.state = robot.state;
      chip.style.setProperty("--mode", modeColour(this.modes, robot.mode));
      chip.title = this.describe(robot.name);
      chip.setAttribute("aria-pressed", String(this.selected.has(robot.name)));
      const planned = robot.planned.length ? `${robot.planned[0].mode} planned` : "";
      const words = { ok: planned, faulted: robot.mode, lost: "lost" }[robot.state] ?? "";
      setText(find(chip, ".state"), words);
    });
    const gone = [...this.selected].filter((name) => !names.includes(name));
    gone.forEach((name) => this.selected.delete(name));
  }

  makeChip(name) {
    const chip = make("button", { type: "button", class: "chip", "aria-pressed": "false" }, [
      make("span", { class: "name", text: name }),
      make("span", { class: "state" }),
      make("span", { class: "life", hidden: true }, [make("i")]),
    ]);
    chip.addEventListener("click", () => this.page.toggle(this, name));
    return make("li", {}, [chip]);
  }

  showHealth(state) {
    if (!this.fights()) return;
    const chips = this.part(".robots").children;
    this.robotIndexes().forEach((actor, i) => {
      const life = chips[i]?.querySelector(".life");
      if (!life) return;
      life.hidden = false;
      life.firstElementChild.style.width = `${100 * state.health[actor]}%`;
      life.classList.toggle("low", state.health[actor] <= 0.35);
      chips[i].firstElementChild.classList.toggle("dead", state.health[actor] <= 0);
    });
  }

  select(names) {
    this.selected = new Set(names.filter((name) => this.robot(name)));
    this.showRobots();
    showSteps(this.part(".steps .rows"), this.team, this.arena, this.selected, this.modes);
    this.dirty = true;
  }

  fights() {
    return Boolean(this.arena?.actors.some((actor) => actor.side === "opponents"));
  }

  // --- drawing ----------------------------------------------------------------------------------

  resize() {
    const box = this.part(".arena").getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
    this.dirty = true;
  }

  /** Where the robots are drawn: [{name, x, y}] in pixels of the page's canvas. */
  places(now = performance.now()) {
    const drawn = this.arena && this.motion.at(now);
    if (!drawn) return [];
    const view = this.view();
    return this.robotIndexes().map((i) => ({
      name: this.arena.actors[i].name,
      x: view.x(drawn.poses[3 * i]),
      y: view.y(drawn.poses[3 * i + 1]),
      radius: draw.bodyRadius(this.arena.actors[i], view),
      alive: drawn.state.health[i] > 0,
    }));
  }

  view() {
    const ratio = window.devicePixelRatio || 1;
    return draw.project(this.camera ?? this.arena.walled_m, this.canvas.width / ratio,
      this.canvas.height / ratio);
  }

  /** Towards what is to be looked at, calmly; whether it is still on its way. */
  moveCamera(state, now) {
    const target = draw.lookAt(this.arena, state, this.canvas.width / this.canvas.height);
    const share = 1 - Math.exp(-(now - (this.movedAt ?? now)) / CAMERA_MS);
    this.movedAt = now;
    const from = this.camera ?? target;
    this.camera = from.map((x, i) => x + share * (target[i] - x));
    return this.camera.some((x, i) => Math.abs(x - target[i]) > 0.01);
  }

  robotAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = event.clientX - box.left;
    const y = event.clientY - box.top;
    let best = "";
    let least = Infinity;
    for (const place of this.places()) {
      const away = Math.hypot(place.x - x, place.y - y);
      if (place.alive && away < least && away <= place.radius + NEAR_PX) {
        least = away;
        best = place.name;
      }
    }
    return best;
  }

  draw(now) {
    const drawn = this.arena && this.motion.at(now);
    this.hits = this.hits.filter((hit) => now - hit.born < HIT_MS);
    if (!drawn || (drawn.settled && !this.dirty && !this.hits.length)) return;
    this.dirty = this.moveCamera(drawn.state, now) || !drawn.settled;
    const ctx = this.canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    const colours = palette();
    const view = this.view();
    const { arena } = this;
    const [width, height] = [this.canvas.width / ratio, this.canvas.height / ratio];
    draw.drawFloor(ctx, arena, view, colours, width, height, drawn.state.done);
    draw.drawTrails(ctx, view, this.trails, colours, (i) => {
      return this.mark(i, drawn.state, colours)?.colour ?? colours.robots;
    });
    const hits = this.hits.map((hit) => ({ ...hit, age: (now - hit.born) / HIT_MS }));
    draw.drawHits(ctx, view, drawn.poses, hits, colours);
    const fights = this.fights();
    // Robots last: they are what one looks for.
    const order = arena.actors.map((_, i) => i).reverse();
    for (const i of order) {
      const actor = arena.actors[i];
      const pose = drawn.poses.slice(3 * i, 3 * i + 3);
      const life = { health: drawn.state.health[i], shield: drawn.state.shield[i] };
      const mark = this.mark(i, drawn.state, colours);
      draw.drawBody(ctx, view, colours, actor, pose, life, mark, this.selected.has(actor.name),
        fights);
    }
  }

  /** How a robot is marked: with the fault in force, or as lost. */
  mark(i, state, colours) {
    const actor = this.arena.actors[i];
    if (actor.side !== "robots") return null;
    const robot = this.robot(actor.name);
    if (robot?.state === "lost") return { tag: "lost", colour: colours.faint, dashed: true };
    if (!state.crashed[i] && robot?.state !== "faulted") return null;
    const mode = robot?.mode || state.modes?.[i] || "crashed";
    return { tag: mode, colour: modeColour(this.modes, mode), dashed: false };
  }
}
