// Between two states of the arena everything moves on straight lines: drawing at any time.

const LEAST_DELAY_MS = 30;
const MOST_DELAY_MS = 400;
const KEPT = 12;

export class Motion {
  constructor() {
    /** @type {{at: number, state: any}[]} */
    this.frames = [];
    this.interval = 100;
  }

  get newest() {
    return this.frames.length ? this.frames[this.frames.length - 1].state : null;
  }

  push(state, now) {
    const last = this.frames[this.frames.length - 1];
    if (last) {
      const gap = Math.min(now - last.at, 1000);
      this.interval += 0.15 * (gap - this.interval);
    }
    this.frames.push({ at: now, state });
    if (this.frames.length > KEPT) this.frames.shift();
  }

  /**
   * What to draw now: the state before it, with the poses between that and the next one.
   * @returns {{state: any, poses: number[], settled: boolean} | null}
   */
  at(now) {
    if (!this.frames.length) return null;
    const delay = Math.min(MOST_DELAY_MS, Math.max(LEAST_DELAY_MS, 1.1 * this.interval));
    const time = now - delay;
    let index = this.frames.length - 1;
    while (index > 0 && this.frames[index].at > time) index -= 1;
    const before = this.frames[index];
    const after = this.frames[index + 1];
    if (!after || !follows(before.state, after.state)) {
      return { state: before.state, poses: before.state.poses, settled: !after };
    }
    const share = Math.min(1, Math.max(0, (time - before.at) / (after.at - before.at || 1)));
    return {
      state: before.state,
      poses: between(before.state.poses, after.state.poses, share),
      settled: false,
    };
  }
}

/** Whether things move from one state to the other, rather than being put there. */
function follows(before, after) {
  return before.episode === after.episode && before.step <= after.step
    && before.poses.length === after.poses.length;
}

function between(from, to, share) {
  const out = [...from];
  for (let i = 0; i < from.length; i += 3) {
    out[i] = from[i] + share * (to[i] - from[i]);
    out[i + 1] = from[i + 1] + share * (to[i + 1] - from[i + 1]);
    const turn = Math.atan2(Math.sin(to[i + 2] - from[i + 2]), Math.cos(to[i + 2] - from[i + 2]));
    out[i + 2] = from[i + 2] + share * turn;
  }
  return out;
}

/** Where each robot was in the last seconds of the simulation. */
export class Trails {
  constructor(seconds = 6, most = 90) {
    this.seconds = seconds;
    this.most = most;
    this.clear();
  }

  clear() {
    /** @type {Map<number, {t: number, x: number, y: number}[]>} */
    this.points = new Map();
    this.episode = -1;
    this.step = -1;
  }

  push(state, robots) {
    if (state.episode !== this.episode || state.step < this.step) {
      this.clear();
      this.episode = state.episode;
    }
    this.step = state.step;
    for (const i of robots) {
      const list = this.points.get(i) ?? [];
      list.push({ t: state.time_s, x: state.poses[3 * i], y: state.poses[3 * i + 1] });
      while (list.length > this.most || list[0].t < state.time_s - this.seconds) list.shift();
      this.points.set(i, list);
    }
  }
}
