// A training's curves: rates between 0 and 1 over the steps of the training.

import { palette } from "./colours.js";
import { find, make } from "./dom.js";

const COLOURS = ["#0072b2", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#e69f00", "#8e6bbf"];
const NAMES = {
  success_rate: "success under crashes",
  success_crash_free: "success, crash-free",
  success_worst: "success, worst victim",
  alpha: "crash rate α",
};
const MARGIN = { left: 40, right: 10, top: 8, bottom: 22 };

export class Curves {
  /** @param {Element} place the panel */
  constructor(place) {
    this.place = /** @type {HTMLElement} */ (place);
    this.canvas = /** @type {HTMLCanvasElement} */ (find(place, "canvas"));
    this.legend = find(place, ".legend");
    this.value = null;
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    new MutationObserver(() => this.draw()).observe(document.documentElement, {
      attributeFilter: ["data-theme"],
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  show(value) {
    this.value = value;
    this.place.hidden = false;
    const names = Object.keys(value.series);
    this.legend.replaceChildren(...names.map((name, i) => {
      const last = value.series[name].findLast((x) => x !== null);
      const item = make("li", { text: `${shown(name)} ${last ?? ""}` });
      item.style.setProperty("--mode", COLOURS[i % COLOURS.length]);
      return item;
    }));
    const figures = names.map((name) => `${shown(name)} ${value.series[name].at(-1)}`);
    this.canvas.setAttribute("aria-label", `Curves of the training, newest: ${figures.join(", ")}`);
    this.draw();
  }

  draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = this.canvas.clientWidth;
    const height = this.canvas.clientHeight;
    if (!this.value || !width) return;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const ctx = this.canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    const { steps, series, unit } = this.value;
    const last = Math.max(1, steps.at(-1) ?? 1);
    const x = (step) => MARGIN.left + ((width - MARGIN.left - MARGIN.right) * step) / last;
    const y = (share) => MARGIN.top + (height - MARGIN.top - MARGIN.bottom) * (1 - share);
    this.axes(ctx, x, y, last, unit, height);
    Object.values(series).forEach((values, i) => {
      ctx.strokeStyle = COLOURS[i % COLOURS.length];
      ctx.lineWidth = 1.8;
      ctx.beginPath();
      let open = false;
      values.forEach((value, k) => {
        if (value === null) open = false;
        else if (open) ctx.lineTo(x(steps[k]), y(value));
        else {
          ctx.moveTo(x(steps[k]), y(value));
          open = true;
        }
      });
      ctx.stroke();
    });
  }

  axes(ctx, x, y, last, unit, height) {
    const colours = palette();
    ctx.font = "11px system-ui, sans-serif";
    ctx.fillStyle = colours.faint;
    ctx.strokeStyle = colours.grid;
    ctx.lineWidth = 1;
    ctx.textBaseline = "middle";
    ctx.textAlign = "right";
    for (const share of [0, 0.25, 0.5, 0.75, 1]) {
      ctx.beginPath();
      ctx.moveTo(x(0), y(share));
      ctx.lineTo(x(last), y(share));
      ctx.stroke();
      ctx.fillText(`${100 * share} %`, x(0) - 4, y(share));
    }
    ctx.textAlign = "left";
    ctx.fillText("0", x(0), height - 8);
    ctx.textAlign = "right";
    ctx.fillText(`${brief(last)} ${unit.replace("_", " ")}`, x(last), height - 8);
  }
}

function shown(name) {
  const victim = /^success_(.+)_crashed$/.exec(name);
  return victim ? `success, ${victim[1]} crashed` : NAMES[name] ?? name;
}

function brief(number) {
  if (number >= 1e6) return `${(number / 1e6).toFixed(1)} million`;
  return number >= 1e4 ? `${Math.round(number / 1e3)} k` : String(number);
}
