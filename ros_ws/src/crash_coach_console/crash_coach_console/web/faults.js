// The form that crashes robots: made of the modes' own schemas.

import { find, make, setText } from "./dom.js";

const LONG = 200; // characters of an answer

export class Faults {
  /** @param {any} page what it asks: stages, selected names, ask */
  constructor(page) {
    this.page = page;
    this.form = /** @type {HTMLFormElement} */ (document.getElementById("faults"));
    this.part = (id) => /** @type {any} */ (find(this.form, `#${id}`));
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.crash();
    });
    this.part("clear").addEventListener("click", () => this.clear());
    this.part("clear-all").addEventListener("click", () => this.clearAll());
    this.part("mode").addEventListener("change", () => this.showMode());
    for (const radio of this.form.querySelectorAll("[name=when]")) {
      radio.addEventListener("change", () => {
        this.part("start-field").hidden = this.when() !== "next_episode";
      });
    }
  }

  when() {
    return new FormData(this.form).get("when");
  }

  setModes(modes) {
    this.modes = modes;
    const select = this.part("mode");
    const before = select.value;
    select.replaceChildren(...modes.map((mode) => make("option", { text: mode.name })));
    if (modes.some((mode) => mode.name === before)) select.value = before;
    this.showMode();
  }

  /** Titles of the teams: with several, one chooses which of them to crash. */
  setTeams(stages) {
    const select = this.part("team");
    const before = select.value;
    const each = stages.map((stage) => {
      return make("option", { value: stage.number, text: find(stage.root, ".title").textContent });
    });
    select.replaceChildren(make("option", { value: "all", text: "all alike" }), ...each);
    if ([...select.options].some((option) => option.value === before)) select.value = before;
    this.part("team-field").hidden = stages.length < 2;
  }

  nextMode() {
    const select = this.part("mode");
    select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
    this.showMode();
  }

  mode() {
    return this.modes.find((mode) => mode.name === this.part("mode").value);
  }

  showMode() {
    const mode = this.mode();
    setText(this.part("mode-summary"), mode.summary.replaceAll("`", ""));
    this.part("parameters").replaceChildren(...mode.parameters.map((parameter) => {
      const unit = parameter.unit === "1" ? "" : ` [${parameter.unit}]`;
      const id = `parameter-${parameter.name}`;
      return make("label", { class: "field" }, [
        `${parameter.name}${unit}`,
        make("input", {
          id,
          name: `parameter:${parameter.name}`,
          type: "number",
          min: parameter.low,
          max: parameter.high,
          step: parameter.is_integer ? 1 : "any",
          value: parameter.example,
          title: `${parameter.description} ${parameter.low} to ${parameter.high}`,
          required: true,
        }),
      ]);
    }));
    this.refresh();
  }

  /** Buttons and words, after another selection or another state of the team. */
  refresh() {
    const names = this.page.selectedNames();
    const mode = this.modes ? this.mode().name : "";
    setText(this.part("selected"), names.length ? names.join(", ")
      : "Click a robot, in the arena or in the list.");
    setText(this.part("crash"), names.length ? `Crash: ${mode}` : "Crash");
    this.part("crash").disabled = !names.length;
    this.part("clear").disabled = !names.some((name) => this.page.isVictim(name));
    const ends = this.page.stages.some((stage) => stage.status.ends_faults);
    const played = this.page.teams().every((stage) => stage.kind === "episodes");
    setText(this.part("stays"), played
      ? "The same episode is played again with the crash, from this step on. One kind of fault at a "
        + "time: another kind replaces it."
      : ends ? "Faults end with the console; closing this page leaves them."
      : "Closing this page or the console leaves faults in force: the coach keeps them until they "
        + "are cleared. One kind of fault at a time: another kind replaces it.");
  }

  async crash(names = this.page.selectedNames()) {
    if (!names.length || !this.form.reportValidity()) return;
    const parameters = {};
    for (const [name, value] of new FormData(this.form)) {
      if (name.startsWith("parameter:")) parameters[name.slice(10)] = Number(value);
    }
    const later = this.when() === "next_episode";
    await this.tell("inject", {
      victims: names,
      mode: this.mode().name,
      parameters,
      apply_at: this.when(),
      start_step: later ? Number(this.part("start").value) : 0,
      duration_steps: Number(this.part("duration").value),
    });
  }

  async clear() {
    const names = this.page.selectedNames().filter((name) => this.page.isVictim(name));
    if (names.length) await this.tell("clear", { robots: names });
  }

  async clearAll() {
    await this.tell("clear", { robots: [] });
  }

  /** The chosen teams are asked, and what they answer is shown. */
  async tell(type, fields) {
    const chosen = this.part("team").value;
    const stages = this.page.teams().filter((stage) => {
      return this.part("team-field").hidden || chosen === "all" || Number(chosen) === stage.number;
    });
    this.say("…", "waiting");
    const answers = await Promise.all(stages.map((stage) => {
      return this.page.link.ask(stage.number, type, fields);
    }));
    const several = answers.length > 1;
    const lines = answers.map((answer, i) => {
      return several ? `${find(stages[i].root, ".title").textContent}: ${answer.text}` : answer.text;
    });
    const same = new Set(answers.map((answer) => answer.text)).size === 1;
    this.say(same ? answers[0].text : lines.join("; "), answers.every((a) => a.ok) ? "ok" : "bad");
  }

  say(text, state) {
    const place = this.part("answer");
    setText(place, text.length > LONG ? `${text.slice(0, LONG)}…` : text);
    place.title = text;
    place.dataset.state = state;
  }
}
