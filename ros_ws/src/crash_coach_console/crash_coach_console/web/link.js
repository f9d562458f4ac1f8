// The connection to the console: messages in, requests out, and again when it is lost.

const AGAIN_MS = [300, 600, 1200, 2500, 5000];
const ANSWER_MS = 15000;

export class Link {
  /**
   * @param {(message: any) => void} onMessage
   * @param {(state: "open" | "lost" | "waiting") => void} onState
   */
  constructor(onMessage, onState) {
    this.onMessage = onMessage;
    this.onState = onState;
    this.tries = 0;
    this.nextId = 1;
    /** @type {Map<number, (answer: {ok: boolean, text: string}) => void>} */
    this.open = new Map();
    this.connect();
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/live${location.search}`);
    this.socket.addEventListener("open", () => {
      this.tries = 0;
      this.onState("open");
    });
    this.socket.addEventListener("message", (event) => this.take(JSON.parse(event.data)));
    this.socket.addEventListener("close", () => this.lose());
  }

  lose() {
    this.onState("lost");
    for (const settle of this.open.values()) {
      settle({ ok: false, text: "the console is gone; what became of the request is not known" });
    }
    this.open.clear();
    const wait = AGAIN_MS[Math.min(this.tries, AGAIN_MS.length - 1)];
    this.tries += 1;
    setTimeout(() => this.connect(), wait);
  }

  take(message) {
    if (message.type === "answer") {
      const settle = this.open.get(message.id);
      this.open.delete(message.id);
      if (settle) settle(message);
    } else {
      this.onMessage(message);
    }
  }

  /** Sends a request; the answer is never an exception. */
  ask(source, type, fields = {}) {
    if (this.socket.readyState !== WebSocket.OPEN) {
      return Promise.resolve({ ok: false, text: "the console is not connected" });
    }
    const id = this.nextId++;
    this.socket.send(JSON.stringify({ type, id, source, ...fields }));
    return new Promise((resolve) => {
      const timer = setTimeout(() => {
        this.open.delete(id);
        resolve({ ok: false, text: "no answer from the console" });
      }, ANSWER_MS);
      this.open.set(id, (answer) => {
        clearTimeout(timer);
        resolve(answer);
      });
    });
  }
}
