// The bar of time: Live, Pause, Play, the slider, the steps, and their keys.

export class Time {
  #dragging = false;
  #pending = null;

  constructor(state, connection) {
    this.state = state;
    this.connection = connection;
    for (const id of ["home", "back", "play", "pause", "forth", "end", "live", "slider", "seconds", "span", "wall", "speed"]) {
      this[id] = document.getElementById(id);
    }
    this.live.addEventListener("click", () => connection.send("live"));
    this.pause.addEventListener("click", () => connection.send("pause"));
    this.play.addEventListener("click", () => this.#startPlaying());
    this.back.addEventListener("click", () => this.#step(false));
    this.forth.addEventListener("click", () => this.#step(true));
    this.home.addEventListener("click", () => this.#jump("home"));
    this.end.addEventListener("click", () => this.#jump("end"));
    this.speed.addEventListener("change", () => this.state.time.mode === "playing" && this.#startPlaying());
    this.slider.addEventListener("input", () => this.#seek(Number(this.slider.value)));
    this.slider.addEventListener("pointerdown", () => (this.#dragging = true));
    addEventListener("pointerup", () => (this.#dragging = false));
    this.seconds.addEventListener("change", () => {
      const value = Number(this.seconds.value.replace(",", "."));
      if (this.seconds.value.trim() && Number.isFinite(value)) this.#seek(value);
      this.seconds.blur();
      this.#draw();
    });
    addEventListener("keydown", (event) => this.#key(event));
    state.on("time selected hello", () => this.#draw());
    // While live, the clock runs between two messages of the server.
    setInterval(() => state.time.mode === "live" && !state.lostSince && this.#draw(), 100);
  }

  // Stand still at a stamp, in ns, as text.
  goTo(stamp) {
    if (this.state.time.mode !== "paused") this.connection.send("pause");
    this.connection.send("seek", { ns: stamp });
  }

  #startPlaying() {
    if (this.state.time.mode === "live") this.#jump("home");
    this.connection.send("play", { speed: Number(this.speed.value) });
  }

  #step(forward) {
    if (this.state.time.mode === "live") this.connection.send("pause");
    this.connection.send("step", { forward, frame: this.state.selected });
  }

  #jump(where) {
    if (this.state.time.mode === "live") this.connection.send("pause");
    this.connection.send(where);
  }

  // Go to a number of seconds from the start, at most once a picture.
  #seek(seconds) {
    const { start } = this.state.time;
    if (start === null) return;
    if (this.#pending === null) {
      requestAnimationFrame(() => {
        this.goTo(this.#pending);
        this.#pending = null;
      });
    }
    this.#pending = String(BigInt(start) + BigInt(Math.round(seconds * 1e9)));
  }

  #key(event) {
    const typing = event.target.closest("input:not([type=range]), select, textarea");
    if (typing || event.ctrlKey || event.altKey || event.metaKey) return;
    const slider = event.target.closest("input[type=range]");
    if (slider && slider !== this.slider) return;
    if (event.key === " " && event.target.closest("button")) return;
    const { mode } = this.state.time;
    const does = {
      " ": () => (mode === "paused" ? this.#startPlaying() : this.connection.send("pause")),
      ArrowLeft: () => this.#step(false),
      ArrowRight: () => this.#step(true),
      Home: () => this.#jump("home"),
      End: () => this.#jump("end"),
    }[event.key];
    if (!does) return;
    event.preventDefault();
    does();
  }

  #draw() {
    const { time, hello, selected } = this.state;
    const buttons = { live: this.live, paused: this.pause, playing: this.play };
    for (const [mode, button] of Object.entries(buttons)) {
      button.setAttribute("aria-pressed", mode === time.mode);
    }
    this.live.hidden = !hello.live;
    const what = selected === null ? "a sample" : `a sample of ${selected}`;
    this.back.title = `Back to ${what} (←)`;
    this.forth.title = `On to ${what} (→)`;
    const known = time.at !== null && time.start !== null;
    for (const each of [this.slider, this.seconds, this.home, this.end, this.back, this.forth, this.play]) {
      each.disabled = !known;
    }
    this.seconds.parentElement.hidden = !known;
    if (!known) {
      this.span.textContent = "";
      this.wall.textContent = time.at === null ? "" : wallTime(time.at);
      return;
    }
    const passed = time.mode === "live" && !this.state.lostSince ? BigInt(Math.round((performance.now() - this.state.timeHeard) * 1e6)) : 0n;
    const at = BigInt(time.at) + passed;
    const seconds = Number(at - BigInt(time.start)) / 1e9;
    const length = Number(BigInt(time.end) - BigInt(time.start)) / 1e9;
    this.slider.max = length;
    if (!this.#dragging) this.slider.value = time.mode === "live" ? length : seconds;
    this.slider.setAttribute("aria-valuetext", `${seconds.toFixed(3)} s of ${length.toFixed(3)} s`);
    if (document.activeElement !== this.seconds) this.seconds.value = seconds.toFixed(time.mode === "live" ? 1 : 3);
    setText(this.span, `of ${length.toFixed(3)} s`);
    setText(this.wall, wallTime(at, time.mode === "live" ? 1 : 3));
  }
}

// The time of day of a stamp in ns, with the date if it is not today; the seconds of a clock that began near zero.
export function wallTime(stamp, digits = 3) {
  const nanoseconds = BigInt(stamp);
  const date = new Date(Number(nanoseconds / 1_000_000n));
  if (nanoseconds < 31_536_000_000_000_000n || Number.isNaN(date.getTime())) return `${(Number(nanoseconds) / 1e9).toFixed(3)} s`;
  const two = (number) => String(number).padStart(2, "0");
  const part = String(date.getMilliseconds()).padStart(3, "0").slice(0, digits);
  const clock = `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}.${part}`;
  const today = new Date();
  if (date.toDateString() === today.toDateString()) return clock;
  const year = date.getFullYear() === today.getFullYear() ? {} : { year: "numeric" };
  return `${date.toLocaleDateString("en-GB", { day: "numeric", month: "short", ...year })}, ${clock}`;
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
