// The panel of the selected frame, the distance to another one, the events, and what the page has to say over the
// picture: the legend, the frames that are still missing, a server that does not answer.

import * as THREE from "./three/three.module.min.js";
import { STATES, TRAILS } from "./scene.js";
import { printable } from "./state.js";
import { wallTime } from "./time.js";

const NOTE = 8_000; // In ms.
const MEANING = {
  static: "It holds at every stamp",
  moving: "It moves",
  stale: "Its newest sample is too old",
  lost: "Its newest sample is too old, and its peer is gone",
  silent: "It has no sample at the shown stamp",
};

const byId = (id) => document.getElementById(id);

function make(tag, text, attributes = {}) {
  const element = document.createElement(tag);
  element.textContent = text;
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}

export class Panel {
  constructor(state, scene, actions) {
    Object.assign(this, { state, scene, actions });
    this.#buildSelection();
    this.#buildSheets();
    state.on("selected choices frames", () => this.#drawChoices());
    state.on("selected details", () => this.#drawFacts());
    state.on("trails selected", () => this.#drawTrail());
    state.on("poses choices selected", () => this.#drawDistance());
    state.on("events", () => this.#drawEvents());
    state.on("states frames scale", () => this.#drawLegend());
    state.on("hello frames lost poses", () => this.#drawTrouble());
    state.on("note", () => this.#note(state.note));
    state.on("robot", () => {
      const { missing } = state.hello;
      if (missing) this.#note(`${missing} meshes of the robot were not found: grey boxes stand for them (--package-path).`);
    });
    this.#drawChoices();
    this.#drawLegend();
    this.#drawTrouble();
  }

  #buildSelection() {
    const { state, actions } = this;
    const click = (id, does) => byId(id).addEventListener("click", does);
    click("deselect", () => actions.select(null));
    click("fix", () => actions.fix(state.selected));
    click("hide-frame", () => state.hide([state.selected], !state.hidden.has(state.selected)));
    click("hide-branch", () => state.hide(state.branch(state.selected), !state.hidden.has(state.selected)));
    click("measure", () => {
      const active = state.measuring || state.measured !== null;
      state.choose({ measuring: !active, measured: null });
    });
    const trail = () => {
      const seconds = Math.min(Math.max(Number(byId("trail-seconds").value) || 10, 0.1), 3600);
      actions.trail(state.selected, byId("trail").checked, seconds);
    };
    byId("trail").addEventListener("change", trail);
    byId("trail-seconds").addEventListener("change", () => byId("trail").checked && trail());
    byId("ellipsoids").addEventListener("change", ({ target }) => state.choose({ ellipsoids: target.checked }));
    byId("follow").addEventListener("change", ({ target }) => {
      const follow = target.value && { frame: state.selected, heading: target.value === "heading" };
      state.choose({ follow: follow || null });
    });
  }

  // On a phone one panel at a time is open below the picture.
  #buildSheets() {
    for (const tab of document.querySelectorAll("#tabs button")) {
      tab.addEventListener("click", () => {
        const { dataset } = document.body;
        dataset.sheet = dataset.sheet === tab.dataset.sheet ? "" : tab.dataset.sheet;
        for (const each of document.querySelectorAll("#tabs button")) {
          each.setAttribute("aria-pressed", each.dataset.sheet === dataset.sheet);
        }
      });
    }
  }

  #drawChoices() {
    const { state } = this;
    const { selected } = state;
    byId("hint").hidden = selected !== null;
    byId("selected").hidden = selected === null;
    byId("selected-name").textContent = printable(selected ?? "");
    const hidden = state.hidden.has(selected);
    byId("hide-frame").setAttribute("aria-pressed", hidden);
    byId("hide-branch").hidden = !state.below[state.index.get(selected)]?.length;
    byId("hide-branch").setAttribute("aria-pressed", hidden);
    byId("fix").setAttribute("aria-pressed", selected !== null && state.chosenFixed === selected);
    byId("measure").setAttribute("aria-pressed", Boolean(state.measuring) || state.measured !== null);
    const { follow } = state;
    byId("follow").value = follow && follow.frame === selected ? (follow.heading ? "heading" : "position") : "";
    const chip = (id, shown, text) => {
      byId(id).hidden = !shown;
      byId(id).textContent = text;
    };
    chip("fixed", state.chosenFixed !== null, `Fixed: ${printable(state.chosenFixed ?? "")} ✕`);
    chip("follow-end", follow !== null, `Follows ${printable(follow?.frame ?? "")} ✕`);
    const names = state.chain.map((place) => state.names[place]);
    byId("chain").replaceChildren(
      ...names.flatMap((name, k) => {
        const step = make("button", printable(name), { class: "link" });
        step.addEventListener("click", () => this.actions.select(name));
        return k ? [make("span", " → "), step] : [step];
      }),
    );
  }

  #drawFacts() {
    const { facts, ellipsoid } = this.state.details;
    byId("ellipsoid").hidden = !ellipsoid;
    if (ellipsoid) byId("ellipsoid-size").textContent = ellipsoid[0].map((axis) => axis.toPrecision(2)).join(" × ");
    const rows = Object.entries(facts).filter(([label]) => label !== "frame" && label !== "chain");
    const list = byId("facts");
    // The elements stay, so that a person can mark and copy a text.
    if (list.dataset.labels !== rows.map(([label]) => label).join()) {
      list.dataset.labels = rows.map(([label]) => label).join();
      list.replaceChildren(...rows.flatMap(([label]) => [make("dt", label), make("dd", "")]));
    }
    rows.forEach(([label, text], k) => {
      const place = list.children[2 * k + 1];
      if (place.dataset.text === text) return;
      place.dataset.text = text;
      const axes = { xyz: ["x", "y", "z"], rpy: ["roll", "pitch", "yaw"], quaternion: ["x", "y", "z", "w"] }[label];
      const parts = text.split(" ");
      if (axes && parts.length > axes.length) {
        place.replaceChildren(...axes.map((axis, j) => {
          const number = make("span", parts[j], { class: "number" });
          number.prepend(make("small", `${axis} `));
          return number;
        }), label === "quaternion" ? "" : ` ${parts[3]}`);
      } else if (/^\d+\.\d+ s$/.test(text)) {
        place.textContent = wallTime(text.replace(/\.(\d+) s/, (_, part) => part.padEnd(9, "0").slice(0, 9)));
        place.title = text;
      } else {
        place.textContent = text;
      }
    });
  }

  #drawTrail() {
    const { trails, selected } = this.state;
    const on = trails.has(selected);
    const box = byId("trail");
    if (performance.now() - (this.actions.trailAt ?? 0) > 500) box.checked = on;
    if (on && document.activeElement !== byId("trail-seconds")) byId("trail-seconds").value = trails.get(selected).seconds;
    byId("trail-colour").style.background = on ? TRAILS[trails.get(selected).colour % TRAILS.length] : "none";
  }

  // From the selected frame to the measured one, in the axes of the selected one.
  #drawDistance() {
    const { state, scene } = this;
    const places = [state.selected, state.measured].map((name) => state.index.get(name));
    const text = byId("distance");
    text.hidden = !(state.measuring || state.measured !== null);
    if (text.hidden) return;
    if (state.measured === null) {
      text.textContent = "Click on the other frame.";
    } else if (!places.every((place) => state.hasPose(place))) {
      text.textContent = "One of the two frames has no pose.";
    } else {
      const back = scene.rotation(places[0]).invert();
      const offset = scene.position(places[1]).sub(scene.position(places[0])).applyQuaternion(back);
      const turn = back.multiply(scene.rotation(places[1]));
      const { x, y, z } = new THREE.Euler().setFromQuaternion(turn, "ZYX");
      const degrees = (angle) => THREE.MathUtils.radToDeg(angle).toFixed(2);
      const angle = 2 * Math.acos(Math.min(Math.abs(turn.w), 1));
      text.textContent = [
        `to ${printable(state.measured)}: ${offset.length().toFixed(4)} m, ${degrees(angle)}°`,
        `x y z ${offset.toArray().map((part) => part.toFixed(4)).join(" ")} m, in the axes of ${printable(state.selected)}`,
        `roll pitch yaw ${[x, y, z].map(degrees).join(" ")}°`,
      ].join("\n");
    }
  }

  #drawEvents() {
    const { events } = this.state;
    byId("event-list").replaceChildren(
      ...events.toReversed().map(({ at, frame, text, peer }) => {
        const button = make("button", "");
        button.append(make("time", wallTime(at)), make("span", printable(text)), ...(peer ? [make("code", peer.slice(0, 8))] : []));
        button.title = frame === null ? "Go to this moment" : "Go to this frame and moment";
        button.addEventListener("click", () => this.actions.goTo(frame, at));
        const item = make("li", "");
        item.append(button);
        return item;
      }),
    );
    byId("no-events").hidden = events.length > 0;
  }

  #drawLegend() {
    const { states } = this.state;
    // Silent frames are rare, so that four words are enough as long as there is none.
    const words = Object.keys(STATES).filter((word) => word !== "silent" || states.includes(word));
    byId("legend").replaceChildren(
      ...words.map((word) => {
        const entry = make("span", word, { title: MEANING[word] });
        entry.prepend(make("i", "", { class: `dot ${word}` }));
        return entry;
      }),
      make("span", `grid ${this.scene.gridStep} m`, { class: "grid" }),
    );
  }

  #drawTrouble() {
    const { state } = this;
    const { lostSince, hello, names } = state;
    document.body.classList.toggle("lost", lostSince !== null);
    byId("trouble").hidden = lostSince === null;
    if (lostSince !== null) {
      const seconds = Math.max(Math.round((Date.now() - lostSince) / 1000), 0);
      const picture = names.length ? " The picture is from then." : "";
      byId("trouble").textContent =
        `The server does not answer since ${lostSince.toLocaleTimeString("en-GB")}, for ${seconds} s.${picture} The page tries again.`;
    }
    document.title = `${lostSince ? "no connection – " : ""}${hello.title || "tfbus"}`;
    const nothing = byId("nothing");
    nothing.hidden = !state.greeted || lostSince !== null || names.length > 0;
    if (nothing.hidden) return;
    const lines = [make("strong", hello.live ? "Waiting for the first frame" : "There is no frame")];
    if (hello.where) lines.push(make("p", `This page shows ${hello.where}${hello.hears ? `, and hears ${hello.hears}` : ""}.`));
    else if (hello.live && !hello.send) lines.push(make("p", "Frames appear as soon as this program publishes them on its bus."));
    if (hello.send) lines.push(make("p", "Send one from another terminal:"), make("code", hello.send));
    nothing.replaceChildren(...lines);
  }

  #note(text) {
    const note = make("p", text);
    byId("notes").append(note);
    setTimeout(() => note.remove(), NOTE);
  }
}
