// The connection to the daemon: one WebSocket that is resumed where it broke, and requests with the same token.

export class Link {
  constructor(on) {
    this.on = on; // { state(name), message(object), ask(why) }
    this.seq = null;
    this.tries = 0;
    this.open();
    addEventListener("online", () => this.again(0));
  }

  get token() {
    return sessionStorage.getItem("oapwatch-token");
  }

  useToken(token) {
    sessionStorage.setItem("oapwatch-token", token);
    this.again(0);
  }

  headers() {
    return this.token ? { Authorization: `Bearer ${this.token}` } : {};
  }

  async request(path, options = {}) {
    const response = await fetch(path, { ...options, headers: { ...this.headers(), ...options.headers }, cache: "no-cache" });
    if (response.status === 401) {
      this.on.ask(this.token ? "That token is not known here." : null);
    }
    if (!response.ok) {
      const problem = await response.json().catch(() => ({}));
      throw Object.assign(new Error(problem.detail ?? response.statusText), { status: response.status });
    }
    return response;
  }

  async json(path, options) {
    return (await this.request(path, options)).json();
  }

  // Saves what stands at `path` as a file: a plain link would not carry the token.
  async save(path, name) {
    const url = URL.createObjectURL(await (await this.request(path)).blob());
    Object.assign(document.createElement("a"), { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10_000);
  }

  async open() {
    clearTimeout(this.timer);
    this.close();
    this.on.state("connecting");
    // A WebSocket does not tell why it was refused; a request does.
    try {
      const probe = await fetch("/v1/status", { headers: this.headers() });
      if (probe.status === 401) {
        this.on.state("refused");
        this.on.ask(this.token ? "That token is not known here." : null);
        return;
      }
    } catch {
      this.again();
      return;
    }
    const after = this.seq === null ? "" : `?after=${this.seq}`;
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const protocols = ["oapwatch.v1"];
    if (this.token) protocols.push(`bearer.${base64url(this.token)}`);
    const socket = new WebSocket(`${scheme}//${location.host}/v1/stream${after}`, protocols);
    this.socket = socket;
    socket.onmessage = (e) => {
      const message = JSON.parse(e.data);
      this.seq = message.seq;
      if (message.type === "snapshot") {
        this.tries = 0;
        this.on.state("live");
      }
      this.on.message(message);
    };
    socket.onclose = () => {
      if (socket === this.socket) this.again();
    };
  }

  close() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  // Tries again after a while: half a second at first, ten at most, spread so that viewers do not all come at once.
  again(wait = Math.min(10000, 500 * 2 ** this.tries++) * (0.7 + 0.6 * Math.random())) {
    this.close();
    this.on.state("lost");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.open(), wait);
  }
}

function base64url(text) {
  const bytes = new TextEncoder().encode(text);
  return btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}
