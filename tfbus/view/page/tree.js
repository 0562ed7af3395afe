// The tree of frames: a click selects, a second one collapses, an eye hides; a filter by pattern.
//
// Frames with a prefix of their own, such as those of robot1/, stand together below a row of the prefix. Only the rows
// in sight are elements.

import { matcher, printable } from "./state.js";

const DEEP = 7; // Below this level, the steps to the right are smaller.
const FIRST_ROWS = 40; // The levels that are open at first have about so many rows.
const collator = new Intl.Collator(undefined, { numeric: true });

export class Tree {
  #rows = [];
  #slots = new Map(); // From the key of a row in sight to its element.
  #opened = new Map(); // From the key of a row to whether a person has opened it.
  #openLevels = 1;

  constructor(state, actions) {
    this.state = state;
    this.actions = actions;
    this.panel = document.getElementById("tree");
    this.list = document.getElementById("tree-rows");
    this.filter = document.getElementById("filter");
    this.filter.addEventListener("input", () => state.choose({ filter: this.filter.value }));
    document.getElementById("only-chain").addEventListener("click", () => {
      state.choose({ onlyChain: !state.onlyChain });
    });
    document.getElementById("show-all").addEventListener("click", () => {
      this.filter.value = "";
      state.hidden.clear();
      state.choose({ filter: "", onlyChain: false });
    });
    this.panel.addEventListener("scroll", () => this.#paint());
    this.panel.addEventListener("keydown", (event) => this.#key(event));
    this.list.addEventListener("click", (event) => this.#click(event));
    this.list.addEventListener("pointerover", (event) => state.hover(this.#rowOf(event)?.frame ?? null));
    this.list.addEventListener("pointerleave", () => state.hover(null));
    new ResizeObserver(() => this.#paint()).observe(this.panel);
    state.on("frames", () => this.#build());
    state.on("choices", () => this.#build());
    state.on("states", () => this.#paint());
    state.on("selected", () => this.#reveal());
    let poses = 0;
    // Whether a frame has a pose changes seldom.
    state.on("poses", () => poses++ % 10 === 0 && this.#paint());
  }

  #build() {
    const { state } = this;
    this.#openLevels = this.#firstLevels();
    this.#rows = /(^|\s)[^!\s]/.test(state.filter) ? this.#matchingRows() : this.#treeRows();
    document.getElementById("only-chain").setAttribute("aria-pressed", state.onlyChain);
    const shown = state.shown.reduce((sum, each) => sum + each, 0);
    document.getElementById("shown-count").textContent =
      shown === state.names.length ? `${shown} frames` : `${shown} of ${state.names.length} frames`;
    this.#paint();
  }

  // The names that somebody looks for are a list; a filter that only excludes leaves the tree.
  #matchingRows() {
    const { names, filter, index } = this.state;
    const found = names.filter(matcher(filter)).sort(collator.compare);
    return found.map((frame) => ({
      key: `f${frame}`, frame, place: index.get(frame), label: frame, level: 0, children: 0,
    }));
  }

  #treeRows() {
    const { state } = this;
    const counts = new Map();
    for (const name of state.names) counts.set(prefixOf(name), (counts.get(prefixOf(name)) ?? 0) + 1);
    const rows = [];
    const add = (row) => {
      row.open = row.children > 0 && this.#isOpen(row);
      rows.push(row);
      return row.open;
    };
    const walk = (places, level, prefix, above) => {
      const groups = new Map();
      const alone = [];
      for (const place of places) {
        const own = prefixOf(state.names[place]);
        if (own && own !== prefix && counts.get(own) > 1) groups.set(own, [...(groups.get(own) ?? []), place]);
        else alone.push(place);
      }
      const byName = (a, b) => collator.compare(state.names[a], state.names[b]);
      for (const place of alone.sort(byName)) {
        const frame = state.names[place];
        const label = prefix && frame.startsWith(prefix) ? frame.slice(prefix.length) : frame;
        const row = { key: `f${frame}`, frame, place, label, level, children: state.below[place].length };
        if (add(row)) walk(state.below[place], level + 1, prefixOf(frame) || prefix, frame);
      }
      for (const own of [...groups.keys()].sort(collator.compare)) {
        const places = groups.get(own).sort(byName);
        const count = places.flatMap((place) => state.branch(state.names[place])).length;
        const row = { key: `g${own}\n${above}`, places, label: own, level, children: places.length, count };
        if (add(row)) walk(places, level + 1, own, above);
      }
    };
    walk(state.roots, 0, "", "");
    return rows;
  }

  // The number of levels that are open before a person opens one.
  #firstLevels() {
    const { state } = this;
    let level = state.roots;
    let rows = level.length;
    let levels = 0;
    while (level.length && (levels < 1 || rows <= FIRST_ROWS)) {
      level = level.flatMap((place) => state.below[place]);
      rows += level.length;
      levels++;
    }
    return rows <= FIRST_ROWS ? Infinity : levels - 1 || 1;
  }

  #isOpen({ key, level }) {
    return this.#opened.get(key) ?? level < this.#openLevels;
  }

  get #height() {
    return parseFloat(getComputedStyle(this.panel).getPropertyValue("--row"));
  }

  // Fill the rows in sight; the element of a row stays the same, so that a click is not lost.
  #paint() {
    const height = this.#height;
    const first = Math.max(Math.floor(this.panel.scrollTop / height) - 3, 0);
    const seen = this.#rows.slice(first, first + Math.ceil(this.panel.clientHeight / height) + 6);
    this.list.style.height = `${this.#rows.length * height}px`;
    const slots = new Map(seen.map(({ key }) => [key, this.#slots.get(key) ?? this.#makeSlot()]));
    for (const [key, slot] of this.#slots) if (!slots.has(key)) slot.remove();
    this.#slots = slots;
    seen.forEach((row, k) => this.#fill(slots.get(row.key), row, (first + k) * height));
    // Readers of the screen want them in order.
    [...slots.values()].reduceRight((next, slot) => {
      if (slot.nextSibling !== next || !slot.isConnected) this.list.insertBefore(slot, next);
      return slot;
    }, null);
  }

  #makeSlot() {
    const slot = document.createElement("div");
    slot.setAttribute("role", "treeitem");
    for (const part of ["eye", "twist", "dot", "name", "count"]) {
      const element = document.createElement(part === "eye" ? "button" : "span");
      element.className = part;
      slot.append((slot[part] = element));
    }
    slot.eye.tabIndex = -1;
    return slot;
  }

  #fill(slot, row, top) {
    const { state } = this;
    slot.row = row;
    const frames = this.#framesOf(row);
    const hidden = frames.every((frame) => state.hidden.has(frame));
    const selected = row.frame !== undefined && row.frame === state.selected;
    slot.style.transform = `translateY(${top}px)`;
    slot.twist.style.marginLeft = `${14 * Math.min(row.level, DEEP) + 4 * Math.max(row.level - DEEP, 0)}px`;
    setText(slot.twist, row.children ? (row.open ? "▾" : "▸") : "");
    setText(slot.name, printable(row.label));
    setText(slot.count, row.count ? `${row.count} frames` : "");
    slot.title = printable(row.frame ?? "");
    slot.dot.className = `dot ${row.frame === undefined ? "none" : state.states[row.place]}`;
    const faint = row.frame !== undefined && !(state.shown[row.place] && (state.hasPose(row.place) || !state.poses.length));
    slot.className = [selected && "selected", faint && "faint", row.frame === undefined && "group"].filter(Boolean).join(" ");
    const attributes = {
      "aria-level": row.level + 1,
      "aria-selected": selected,
      "aria-label": printable(row.frame ?? row.label) + (row.frame ? `, ${state.states[row.place]}` : `, ${row.count} frames`),
    };
    for (const [name, value] of Object.entries(attributes)) {
      if (slot.getAttribute(name) !== String(value)) slot.setAttribute(name, value);
    }
    if (row.children) slot.setAttribute("aria-expanded", row.open);
    else slot.removeAttribute("aria-expanded");
    slot.eye.className = hidden ? "eye closed" : "eye";
    slot.eye.setAttribute("aria-pressed", hidden);
    slot.eye.setAttribute("aria-label", `Hide ${printable(row.label)}`);
    slot.eye.title = row.children ? "Hide or show this branch (with Shift: this frame alone)" : "Hide or show this frame";
  }

  #framesOf(row) {
    if (row.frame !== undefined && !row.children) return [row.frame];
    return (row.places ?? [row.place]).flatMap((place) => this.state.branch(this.state.names[place]));
  }

  #rowOf(event) {
    return event.target.closest("[role=treeitem]")?.row;
  }

  #click(event) {
    const row = this.#rowOf(event);
    if (!row) return;
    if (event.target.className.includes("eye")) {
      const frames = event.shiftKey && row.frame !== undefined ? [row.frame] : this.#framesOf(row);
      this.state.hide(frames, !frames.every((frame) => this.state.hidden.has(frame)));
    } else if (row.frame === undefined || event.target.className === "twist" || row.frame === this.state.selected) {
      this.#turn(row);
    } else if (event.shiftKey && this.state.selected !== null) {
      this.state.choose({ measured: row.frame });
    } else {
      this.actions.select(row.frame);
    }
  }

  #turn(row) {
    if (!row.children) return;
    this.#opened.set(row.key, !row.open);
    this.#build();
  }

  #key(event) {
    const at = this.#rows.findIndex((row) => row.frame !== undefined && row.frame === this.state.selected);
    if (event.key === "Enter" && at >= 0) this.#turn(this.#rows[at]);
    const step = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    let next = at + step;
    while (this.#rows[next] && this.#rows[next].frame === undefined) next += step;
    if (this.#rows[next]) this.actions.select(this.#rows[next].frame);
  }

  // Open what is above the selected frame, and scroll to it.
  #reveal() {
    const { state } = this;
    const find = () => this.#rows.findIndex((row) => row.frame === state.selected);
    if (state.selected !== null && state.index.has(state.selected) && find() < 0) {
      // Each turn opens the row that hides it: its nearest ancestor, or the group of its prefix.
      for (let turns = 0; find() < 0 && turns < 1000; turns++) {
        const closed = this.#rows.findLast(
          (row) => !row.open && row.children && row.frame !== state.selected && this.#framesOf(row).includes(state.selected),
        );
        if (!closed) break;
        this.#opened.set(closed.key, true);
        this.#build();
      }
    }
    const at = find();
    if (at >= 0) {
      const height = this.#height;
      const { scrollTop, clientHeight } = this.panel;
      if (at * height < scrollTop || (at + 1) * height > scrollTop + clientHeight) {
        this.panel.scrollTop = at * height - clientHeight / 3;
      }
    }
    this.#build();
  }
}

function prefixOf(name) {
  return name.slice(0, name.indexOf("/") + 1);
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
