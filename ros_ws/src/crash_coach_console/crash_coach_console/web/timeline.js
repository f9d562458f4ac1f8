// The time line of an episode that is over: where it stands, who was faulted when.

import { modeColour, palette } from "./colours.js";
import { find } from "./dom.js";

export class Timeline {
  /**
   * @param {HTMLElement} root of the stage
   * @param {any[]} modes
   * @param {(type: string, fields?: object) => void} ask
   */
  constructor(root, modes, ask) {
    this.modes = modes;
    this.place = /** @type {HTMLElement} */ (find(root, ".timeline"));
    this.range = /** @type {HTMLInputElement} */ (find(this.place, "[type=range]"));
    this.number = /** @type {HTMLInputElement} */ (find(this.place, "[type=number]"));
    this.speed = /** @type {HTMLSelectElement} */ (find(this.place, "select"));
    this.canvas = /** @type {HTMLCanvasElement} */ (find(this.place, "canvas"));
    this.back = /** @type {HTMLElement} */ (find(root, ".back"));
    this.playing = false;
    this.held = false; // by the user's hand
    this.value = null;
    this.range.addEventListener("pointerdown", () => {
      this.held = true;
      ask("pause", { on: true });
    });
    this.range.addEventListener("pointerup", () => {
      this.held = false;
    });
    this.range.addEventListener("input", () => ask("seek", { frame: Number(this.range.value) }));
    this.number.addEventListener("change", () => {
      ask("choose", { episode: Math.max(0, Math.round(Number(this.number.value))) });
    });
    this.speed.addEventListener("change", () => ask("pace", { speed: Number(this.speed.value) }));
  }

  show(value) {
    const drawn = JSON.stringify([value.stretches, value.last]);
    this.place.hidden = false;
    this.back.hidden = false;
    this.value = value;
    this.playing = value.playing;
    this.range.max = String(value.last);
    this.seen(value.frame);
    if (document.activeElement !== this.number) this.number.value = String(value.episode);
    if (drawn !== this.drawn) {
      this.drawn = drawn;
      this.draw();
    }
  }

  seen(frame) {
    if (!this.held) this.range.value = String(frame);
  }

  /** A line per faulted robot, coloured as its mode, along the steps. */
  draw() {
    const { stretches, last } = this.value;
    const robots = [...new Set(stretches.map((stretch) => stretch.robot))];
    const ratio = window.devicePixelRatio || 1;
    const width = this.canvas.clientWidth || 300;
    const height = 6 * Math.max(1, robots.length);
    this.canvas.style.height = `${height}px`;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const ctx = this.canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    ctx.fillStyle = palette().lack;
    ctx.fillRect(0, height / 2 - 0.5, width, 1);
    for (const stretch of stretches) {
      ctx.fillStyle = modeColour(this.modes, stretch.mode);
      const left = (width * stretch.from) / Math.max(1, last);
      const right = (width * stretch.to) / Math.max(1, last);
      ctx.fillRect(left, 6 * robots.indexOf(stretch.robot) + 1, Math.max(2, right - left), 4);
    }
  }
}
