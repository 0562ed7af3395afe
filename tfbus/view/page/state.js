// What the page knows: the facts that the server has told, and the choices of the person at this browser.
//
// The other modules change it by its methods, and hear of changes by `on`. It draws nothing and sends nothing.

const NO_SELECTION = { frame: null, facts: {}, chain: [], parent: null, xyz: null, xyzw: null, ellipsoid: null };

export class State {
  #listeners = new Map();

  // From the server.
  hello = { live: true, robot: false, edit: [], save: null, title: "tfbus", where: "", hears: "", send: "" };
  greeted = false;
  lostSince = null; // A Date while the server does not answer.
  names = [];
  parents = [];
  states = [];
  fixed = null;
  chosenFixed = null;
  index = new Map(); // From name to place.
  below = []; // By place, the places of the children.
  roots = [];
  clouds = [];
  poses = new Float32Array(0); // 7 numbers a row: x y z, quaternion x y z w; NaN where there is no pose.
  time = { mode: "live", at: null, start: null, end: null, speed: 1, now: "0" };
  timeHeard = 0; // In ms, as performance.now().
  details = NO_SELECTION;
  trails = new Map(); // From frame to {seconds, colour}, the colour by its number.
  events = [];

  // From the person at this browser.
  selected = null;
  hovered = null;
  hidden = new Set();
  filter = "";
  onlyChain = false;
  namesMode = "some";
  ellipsoids = true; // Whether the error of the selected frame is drawn, if it is known.
  follow = null; // {frame, heading}
  measured = null; // The frame that the distance to the selected one is measured from.
  chain = []; // Places, from the selected frame to the fixed one.
  shown = new Uint8Array(0); // By place, whether the choices let the frame be drawn.

  on(names, listener) {
    for (const name of names.split(" ")) {
      if (!this.#listeners.has(name)) this.#listeners.set(name, []);
      this.#listeners.get(name).push(listener);
    }
  }

  tell(name) {
    for (const listener of this.#listeners.get(name) ?? []) listener();
  }

  setFrames({ names, parents, fixed, chosen_fixed: chosenFixed }) {
    Object.assign(this, { names, parents, fixed, chosenFixed });
    this.index = new Map(names.map((name, place) => [name, place]));
    this.below = names.map(() => []);
    this.roots = [];
    parents.forEach((parent, place) => (parent < 0 ? this.roots : this.below[parent]).push(place));
    this.states = this.states.length === names.length ? this.states : names.map(() => "static");
    this.poses = new Float32Array(0);
    this.#choose();
    this.tell("frames");
  }

  setPoses(rows) {
    this.poses = rows;
    this.tell("poses");
  }

  hasPose(place) {
    return place !== undefined && 7 * place < this.poses.length && !Number.isNaN(this.poses[7 * place]);
  }

  drawn(place) {
    return this.shown[place] === 1 && this.hasPose(place);
  }

  select(frame) {
    if (frame === this.selected) return;
    this.selected = frame;
    this.details = { ...NO_SELECTION, frame };
    this.#choose();
    this.tell("selected");
  }

  hover(frame) {
    if (frame === this.hovered) return;
    this.hovered = frame;
    this.tell("hovered");
  }

  // Choose what is shown: {filter}, {onlyChain}, {namesMode}, {follow}, {measured}.
  choose(choices) {
    Object.assign(this, choices);
    this.#choose();
    this.tell("choices");
  }

  hide(frames, hidden) {
    for (const frame of frames) hidden ? this.hidden.add(frame) : this.hidden.delete(frame);
    this.choose({});
  }

  // The names of a frame and of all frames below it.
  branch(frame) {
    const found = [];
    const open = this.index.has(frame) ? [this.index.get(frame)] : [];
    while (open.length) {
      const place = open.pop();
      found.push(this.names[place]);
      open.push(...this.below[place]);
    }
    return found;
  }

  // A trail keeps its colour, and a new one gets the first that is free.
  setTrails(trails) {
    const kept = new Map();
    const used = trails.filter(({ frame }) => this.trails.has(frame)).map(({ frame }) => this.trails.get(frame).colour);
    for (const { frame, seconds } of trails) {
      let colour = this.trails.get(frame)?.colour ?? 0;
      while (!this.trails.has(frame) && used.includes(colour)) colour++;
      used.push(colour);
      kept.set(frame, { seconds, colour });
    }
    this.trails = kept;
    this.tell("trails");
  }

  setTime(time) {
    this.time = time;
    this.timeHeard = performance.now();
    this.tell("time");
  }

  #choose() {
    this.chain = this.#chainOf(this.selected);
    const matches = matcher(this.filter);
    this.shown = Uint8Array.from(this.names, (name) => matches(name) && !this.hidden.has(name));
    if (this.onlyChain && this.chain.length) {
      const chain = new Set(this.chain);
      this.shown.forEach((_, place) => (this.shown[place] = chain.has(place) && !this.hidden.has(this.names[place])));
    }
  }

  #ancestors(place) {
    const found = [];
    for (; place >= 0 && found.length <= this.names.length; place = this.parents[place]) found.push(place);
    return found;
  }

  // Up from the selected frame to the first one that is above the fixed frame too, and down from there.
  #chainOf(frame) {
    if (!this.index.has(frame)) return [];
    const up = this.#ancestors(this.index.get(frame));
    if (!this.index.has(this.fixed)) return up;
    const down = this.#ancestors(this.index.get(this.fixed));
    const meeting = up.findIndex((place) => down.includes(place));
    return meeting < 0 ? up : [...up.slice(0, meeting + 1), ...down.slice(0, down.indexOf(up[meeting])).reverse()];
  }
}

// A function that says whether a name matches a filter: words that are parts of names, or patterns of whole names with
// * and ?; a word after a ! excludes. A name must match one of the words, unless all of them exclude.
export function matcher(filter) {
  const words = { wanted: [], unwanted: [] };
  for (const word of filter.split(/\s+/)) {
    const text = word.replace(/^!/, "");
    if (!text) continue;
    const pattern = text.replace(/[.+^${}()|[\]\\]/g, "\\$&").replace(/\*+/g, ".*").replace(/\?/g, ".");
    const whole = /[*?]/.test(text) ? `^${pattern}$` : pattern;
    words[word.startsWith("!") ? "unwanted" : "wanted"].push(new RegExp(whole, "isu"));
  }
  const { wanted, unwanted } = words;
  return (name) =>
    (!wanted.length || wanted.some((each) => each.test(name))) && !unwanted.some((each) => each.test(name));
}

// A name without the characters that would hide a letter, turn the line around or begin another one: they are escaped.
export function printable(name) {
  return name.replace(/\p{C}|[\p{Zl}\p{Zp}]|(?! )\p{Zs}/gu, (letter) => `\\u{${letter.codePointAt(0).toString(16)}}`);
}
