// Sound and notifications of the browser, both off until they are asked for and remembered in this browser.

import { kindName, shown } from "./words.js";

const AGAIN_MS = 3000;

export class Bell {
  constructor() {
    this.context = null;
    this.rung = 0;
    const $ = (id) => document.getElementById(id);
    this.sound = $("sound");
    this.notify = $("notify");
    this.sound.addEventListener("click", () => {
      this.set(this.sound, "oapwatch-sound", !this.isOn(this.sound));
      if (this.isOn(this.sound)) this.tone(1);
      this.say();
    });
    this.notify.addEventListener("click", () => this.ask());
    this.set(this.sound, "oapwatch-sound", localStorage.getItem("oapwatch-sound") === "on");
    this.notify.hidden = !("Notification" in window);
    const granted = "Notification" in window && Notification.permission === "granted";
    this.set(this.notify, "oapwatch-notify", granted && localStorage.getItem("oapwatch-notify") === "on");
    // Browsers allow sound only after the reader has touched the page once, also where it was asked for before.
    if (this.isOn(this.sound)) this.wake();
    for (const touch of ["pointerdown", "keydown"]) addEventListener(touch, () => this.isOn(this.sound) && this.wake());
  }

  wake() {
    if (!this.context) {
      this.context = new AudioContext();
      this.context.addEventListener("statechange", () => this.say());
    }
    this.context.resume();
    this.say();
  }

  // A silent browser is not to look like one that will ring.
  say() {
    const isMute = this.isOn(this.sound) && this.context?.state !== "running";
    this.sound.textContent = isMute ? "Sound: touch the page" : "Sound";
  }

  isOn(button) {
    return button.getAttribute("aria-pressed") === "true";
  }

  set(button, key, on) {
    button.setAttribute("aria-pressed", String(on));
    localStorage.setItem(key, on ? "on" : "off");
  }

  async ask() {
    const wanted = !this.isOn(this.notify);
    const allowed = wanted && (await Notification.requestPermission()) === "granted";
    this.set(this.notify, "oapwatch-notify", allowed);
    this.notify.title = wanted && !allowed ? "This browser does not allow notifications of this page" : "";
  }

  raised(alert) {
    // Thirty alerts at once are one sound and one notification.
    if (Date.now() - this.rung < AGAIN_MS) return;
    this.rung = Date.now();
    if (this.isOn(this.sound)) this.tone(alert.severity === "critical" ? 3 : 1);
    if (this.isOn(this.notify) && document.hidden) {
      new Notification(`oapwatch: ${kindName(alert.kind)}`, { body: [alert.severity, alert.user && `user ${shown(alert.user)}`].filter(Boolean).join(", "), tag: "oapwatch" });
    }
  }

  tone(times) {
    this.wake();
    for (let k = 0; k < times; k++) {
      const at = this.context.currentTime + 0.28 * k;
      const oscillator = new OscillatorNode(this.context, { frequency: 880 });
      const gain = new GainNode(this.context, { gain: 0 });
      gain.gain.setValueAtTime(0.2, at);
      gain.gain.exponentialRampToValueAtTime(0.001, at + 0.22);
      oscillator.connect(gain).connect(this.context.destination);
      oscillator.start(at);
      oscillator.stop(at + 0.24);
    }
  }
}
