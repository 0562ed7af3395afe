// The page: it puts the parts together, and does what needs several of them.

import { Camera } from "./camera.js";
import { Connection } from "./connection.js";
import { Handle } from "./handle.js";
import { Names } from "./names.js";
import { Panel } from "./panel.js";
import { Scene } from "./scene.js";
import { State } from "./state.js";
import { Time } from "./time.js";
import { Tree } from "./tree.js";

const CLICK = 5; // In pixels: a longer way of the pointer is a drag.

const byId = (id) => document.getElementById(id);
const canvas = byId("canvas");

const state = new State();
const scene = new Scene(canvas, state);
const camera = new Camera(scene, state, canvas);
const connection = new Connection(state, scene);
const time = new Time(state, connection);

const actions = {
  // Select a frame, or measure to it if the person has asked for that.
  select(frame) {
    if (state.measuring && frame !== null && frame !== state.selected) {
      state.choose({ measured: frame, measuring: false });
      return;
    }
    if (frame !== state.selected) {
      state.measuring = false;
      state.measured = null;
      state.select(frame);
      connection.send("select", { frame });
    }
  },
  fix(frame) {
    connection.send("fixed", { frame: frame === state.chosenFixed ? null : frame });
  },
  trail(frame, on, seconds) {
    this.trailAt = performance.now();
    connection.send("trail", { frame, on, seconds });
  },
  goTo(frame, stamp) {
    if (frame !== null) this.select(frame);
    time.goTo(stamp);
  },
};

new Names(byId("names"), scene, state);
new Tree(state, actions);
new Panel(state, scene, actions);
const handle = new Handle(state, scene, camera, connection);

// The picture: a click selects, moving over a frame shows its name.
let pressed = null;
const where = ({ offsetX, offsetY }) => [offsetX, offsetY];
canvas.addEventListener("pointerdown", (event) => (pressed = handle.busy ? null : where(event)));
canvas.addEventListener("pointerup", (event) => {
  if (!pressed) return;
  const [x, y] = where(event);
  const moved = Math.hypot(x - pressed[0], y - pressed[1]);
  pressed = null;
  if (moved > CLICK || event.button !== 0) return;
  const place = scene.pick(x, y);
  if (place === undefined) actions.select(null);
  else if (event.shiftKey && state.selected !== null) state.choose({ measured: state.names[place] });
  else actions.select(state.names[place]);
});
canvas.addEventListener("pointermove", (event) => {
  if (event.buttons || event.pointerType === "touch") return;
  const place = scene.nearest(...where(event), 12);
  state.hover(place === undefined ? null : state.names[place]);
  canvas.style.cursor = place === undefined ? "" : "pointer";
});

// The toolbar.
byId("fit").addEventListener("click", () => camera.fit());
byId("names-mode").addEventListener("change", ({ target }) => state.choose({ namesMode: target.value }));
byId("axes").addEventListener("input", ({ target }) => {
  scene.axesChoice = Number(target.value);
  scene.wake();
});
byId("robot").addEventListener("input", ({ target }) => scene.setOpacity(Number(target.value)));
byId("more").addEventListener("click", ({ target }) => {
  target.setAttribute("aria-pressed", target.getAttribute("aria-pressed") !== "true");
});
byId("fixed").addEventListener("click", () => connection.send("fixed", { frame: null }));
byId("follow-end").addEventListener("click", () => state.choose({ follow: null }));
state.on("robot", () => (byId("robot-control").hidden = false));

// The keys belong to the picture again after a click or a choice with the pointer.
let pointed = false;
addEventListener("pointerdown", () => (pointed = true), true);
addEventListener("keydown", () => (pointed = false), true);
addEventListener("click", ({ target }) => pointed && target.closest("button")?.blur());
addEventListener("change", ({ target }) => pointed && target.matches("select, [type=checkbox], [type=range]") && target.blur());
addEventListener("keydown", (event) => {
  if (event.target.closest("input:not([type=range]), select")) return;
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === "f") camera.fit();
  if (event.key === "Escape") actions.select(null);
});
