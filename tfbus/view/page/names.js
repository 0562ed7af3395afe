// The names of frames in the picture: the most important and nearest ones first, and none on top of another.
//
// The selected, measured and pointed frames come first, then the chain, then the fixed frame. Of the others, those count
// that carry many frames, and those that are near.

import { printable } from "./state.js";

const FEW = 20;
const AREA = 12_000; // In square pixels, for each name.
const GAP = 8; // From the dot to its name, in pixels.
const HEIGHT = 17;
const PADDING = 3;
const LONG = 36; // A name with more letters is cut in the middle.

export class Names {
  #labels = new Map(); // From name to its element.
  #widths = new Map();
  #weights = [];
  #pen = document.createElement("canvas").getContext("2d");

  constructor(container, scene, state) {
    this.container = container;
    this.scene = scene;
    this.state = state;
    scene.beforeDraw = () => this.draw();
    state.on("frames", () => this.#weigh());
  }

  draw() {
    this.#pen.font = getComputedStyle(this.container).font;
    const { clientWidth: width, clientHeight: height } = this.container;
    const most = this.state.namesMode === "all" ? Infinity : Math.min(FEW, (width * height) / AREA);
    const taken = [];
    const kept = new Map();
    for (const { name, x, y, rank } of this.#candidates()) {
      if (kept.size >= most && rank === 0) break;
      const box = [this.#width(name) + 2 * PADDING, HEIGHT];
      // To the right of its dot, or else to the left, or in the lines above and below; not beyond the picture.
      const middle = Math.min(Math.max(x - box[0] / 2, 0), width - box[0]);
      const corners = (rank ? [0, -1, 1, -2, 2] : [0, -1, 1]).flatMap((line) => {
        const top = y + line * (HEIGHT + 1) - HEIGHT / 2;
        return [x + GAP, x - GAP - box[0], ...(line ? [middle] : [])].map((left) => [Math.round(left), Math.round(top)]);
      });
      const corner = corners.find(([left, top]) => {
        const right = left + box[0];
        const bottom = top + box[1];
        const inside = left >= 0 && top >= 0 && right <= width && bottom <= height;
        return inside && taken.every((t) => right < t[0] || left > t[2] || bottom < t[1] || top > t[3]);
      });
      if (!corner) continue;
      taken.push([...corner, corner[0] + box[0], corner[1] + box[1]]);
      kept.set(name, [corner, rank]);
    }
    this.#show(kept);
  }

  // The frames that may have a name, the most important first.
  #candidates() {
    const { state, scene } = this;
    const chain = new Set(state.chain);
    const found = [];
    state.names.forEach((name, place) => {
      if (!state.drawn(place)) return;
      let rank = 0;
      if (state.namesMode !== "none" && chain.has(place)) rank = 2;
      if (state.namesMode !== "none" && name === state.fixed) rank = 1;
      if ([state.selected, state.hovered, state.measured].includes(name)) rank = 3;
      if (rank === 0 && (state.namesMode === "none" || state.namesMode === "chain")) return;
      const at = scene.onScreen(scene.position(place));
      if (at) found.push({ name, place, rank, ...at });
    });
    found.sort((a, b) => a.depth - b.depth);
    found.forEach((each, k) => {
      // A name that was there stays, so that names do not flicker.
      each.merit = this.#weights[each.place] - k / found.length + (this.#labels.has(each.name) ? 0.15 : 0);
    });
    return found.sort((a, b) => b.rank - a.rank || b.merit - a.merit);
  }

  // A frame is the more important the more frames are below it; one that carries all others weighs 1.
  #weigh() {
    const { names, parents, roots, below } = this.state;
    const counts = names.map(() => 1);
    const order = [...roots];
    for (let k = 0; k < order.length; k++) order.push(...below[order[k]]);
    for (const place of order.reverse()) if (parents[place] >= 0) counts[parents[place]] += counts[place];
    this.#weights = counts.map((count) => Math.log(count) / Math.log(names.length + 1));
  }

  #show(kept) {
    for (const [name, label] of this.#labels) {
      if (kept.has(name)) continue;
      label.remove();
      this.#labels.delete(name);
    }
    for (const [name, [[left, top], rank]] of kept) {
      let label = this.#labels.get(name);
      if (!label) {
        label = document.createElement("span");
        label.textContent = short(name);
        this.container.append(label);
        this.#labels.set(name, label);
      }
      label.className = ["", "fixed", "chain", "selected"][rank];
      label.style.transform = `translate(${left}px, ${top}px)`;
    }
  }

  #width(name) {
    let width = this.#widths.get(name);
    if (width === undefined) {
      width = Math.min(Math.ceil(this.#pen.measureText(short(name)).width) + 1, 300);
      this.#widths.set(name, width);
    }
    return width;
  }
}

function short(name) {
  const text = printable(name);
  return text.length > LONG ? `${text.slice(0, LONG / 2 - 1)}…${text.slice(-LONG / 2)}` : text;
}
