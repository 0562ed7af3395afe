// The websocket to the server: it fills the state with what the server sends, sends what people do, and connects again.
//
// Texts are JSON. A binary message begins with its kind: 1 poses, 2 points, 3 trails, 4 the robot. Kinds 2 to 4 have a
// header in JSON after its length; everything is little endian.

const RETRY = 1_000; // In ms.
const SILENCE = 5_000; // In ms: a server whose clock stands still for so long is in trouble.
const EVENTS = 300;

export class Connection {
  #state;
  #scene;
  #socket = null;
  #heard = Date.now();

  constructor(state, scene) {
    this.#state = state;
    this.#scene = scene;
    setInterval(() => this.#checkSilence(), 1_000);
    this.#connect();
  }

  // Send what a person did; it is lost without a connection.
  send(what, values = {}) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify({ do: what, ...values }));
  }

  #connect() {
    const address = new URL("socket", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    const socket = (this.#socket = new WebSocket(address));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.#repeatChoices();
    socket.onmessage = ({ data }) => {
      this.#heard = Date.now();
      this.#setLost(null);
      if (typeof data === "string") this.#takeText(JSON.parse(data));
      else this.#takeBinary(data);
    };
    socket.onclose = () => {
      this.#setLost(this.#state.lostSince ?? new Date());
      setTimeout(() => this.#connect(), RETRY);
    };
  }

  #checkSilence() {
    const live = this.#socket.readyState === WebSocket.OPEN && this.#state.greeted && this.#state.time.mode === "live";
    if (live && Date.now() - this.#heard > SILENCE) this.#setLost(new Date(this.#heard));
    if (this.#state.lostSince) this.#state.tell("lost");
  }

  #setLost(since) {
    const changed = (since === null) !== (this.#state.lostSince === null);
    this.#state.lostSince = since;
    if (changed) this.#state.tell("lost");
  }

  // The server knows nothing of a browser that comes again.
  #repeatChoices() {
    const { greeted, chosenFixed, selected, trails, time } = this.#state;
    this.#state.events = [];
    if (!greeted) return;
    if (chosenFixed !== null) this.send("fixed", { frame: chosenFixed });
    if (selected !== null) this.send("select", { frame: selected });
    for (const [frame, { seconds }] of trails) this.send("trail", { frame, on: true, seconds });
    if (time.mode !== "live" && time.at !== null) {
      this.send("pause");
      this.send("seek", { ns: time.at });
    }
  }

  #takeText(message) {
    const state = this.#state;
    switch (message.type) {
      case "hello":
        state.hello = message;
        state.greeted = true;
        state.tell("hello");
        break;
      case "frames":
        state.setFrames(message);
        break;
      case "states":
        state.states = message.states;
        state.tell("states");
        break;
      case "clouds":
        state.clouds = message.names;
        this.#scene.keepClouds(message.names);
        break;
      case "time":
        state.setTime(message);
        break;
      case "selection":
        // An answer about an earlier selection is late.
        if (message.frame !== state.selected) break;
        state.details = message;
        state.tell("details");
        break;
      case "events":
        state.events = [...state.events, ...message.events].slice(-EVENTS);
        state.tell("events");
        break;
      case "saved":
        state.note = `saved: ${message.frames.join(", ")} → ${message.path}`;
        state.tell("note");
        break;
      case "error":
        state.note = message.text;
        state.tell("note");
        break;
    }
  }

  #takeBinary(data) {
    const kind = new Uint8Array(data, 0, 1)[0];
    if (kind === 1) {
      this.#state.setPoses(new Float32Array(data, 4));
      return;
    }
    const length = new Uint32Array(data, 4, 1)[0];
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 8, length)));
    const payload = 8 + length;
    if (kind === 2) this.#takePoints(header, data, payload);
    if (kind === 3) this.#takeTrails(header, new Float32Array(data, payload));
    if (kind === 4) this.#takeRobot(header, data, payload);
  }

  #takePoints(header, data, payload) {
    const points = new Float32Array(data, payload, 3 * header.count);
    const colours = header.colours ? new Uint8Array(data, payload + points.byteLength, 3 * header.count) : null;
    this.#scene.setCloud(header, points, colours);
  }

  #takeTrails({ trails }, points) {
    let begin = 0;
    this.#scene.setTrails(
      trails.map(({ frame, count }) => ({ frame, points: points.subarray(begin, (begin += 3 * count)) })),
    );
    this.#state.setTrails(trails);
  }

  #takeRobot(header, data, payload) {
    const meshes = header.meshes.map(({ vertices, faces }) => {
      const corners = new Float32Array(data, payload, 3 * vertices);
      const triangles = new Uint32Array(data, payload + corners.byteLength, 3 * faces);
      payload += corners.byteLength + triangles.byteLength;
      return { corners, triangles };
    });
    this.#scene.setRobot(meshes, header.solids);
  }
}
