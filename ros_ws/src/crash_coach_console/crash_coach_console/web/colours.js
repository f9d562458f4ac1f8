// Colours of the drawing, light and dark; Okabe and Ito's palette, told apart by everybody.

const MODES = [
  "#7d8590", "#cc79a7", "#56b4e9", "#e69f00", "#b08900", "#009e73",
  "#2f9e8f", "#d64545", "#8e6bbf", "#a0724f", "#5f7f2f",
];

const LIGHT = {
  outside: "#e8ebef", floor: "#ffffff", grid: "#e6e9ee", wall: "#9aa4b0", rough: "#f1ece2",
  ink: "#1c2733", faint: "#6b7784", robots: "#0072b2", opponents: "#d55e00", things: "#a3825a",
  site: "#f4c95d", done: "#8fcf9f", health: "#009e73", hurt: "#d64545", shield: "#56b4e9",
  lack: "#d4d9df", selected: "#111827", hit: "#e0a800", onBody: "#ffffff",
};

const DARK = {
  outside: "#10161d", floor: "#1a222b", grid: "#26303b", wall: "#5b6875", rough: "#2a2721",
  ink: "#e8edf2", faint: "#93a0ad", robots: "#3d9ad6", opponents: "#e8813a", things: "#b08e64",
  site: "#b8902f", done: "#3f8f55", health: "#35b98c", hurt: "#e5686a", shield: "#7cc7f2",
  lack: "#3a4450", selected: "#ffffff", hit: "#ffd54a", onBody: "#ffffff",
};

export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

export function palette() {
  return isDark() ? DARK : LIGHT;
}

/** A colour per fault mode, in the order in which the console names them. */
export function modeColour(modes, name) {
  const index = modes.findIndex((mode) => mode.name === name);
  return MODES[(index < 0 ? MODES.length - 1 : index) % MODES.length];
}
