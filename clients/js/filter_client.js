// Client of the filter service for Node. Protocol: filter_service/PROTOCOL.md.
//
//     const client = new FilterClient("tcp://127.0.0.1:5577");
//     await client.hello();
//     await client.setProfile({ kind: "preset", name: "keratoconus" }, { views: [camera] });
//     const seen = await client.filter([view], { pupilMm: 4, focusDpt: 0 });
//     client.close();
//
// A camera is { widthPx, heightPx, tangents: [left, right, up, down] }. A view is a
// camera with color, a Uint8Array of sRGB or a Float32Array of linear light, and
// depthM, a Float32Array of meters. Optional fields of a view are eye ("left" or
// "right"), the state of that eye (pupilMm, focusDpt, gazeDeg), and pose (seven numbers,
// which the result repeats). Calls of `filter` must not overlap.

import { decode, encode } from "@msgpack/msgpack";
import { Dealer } from "zeromq";

const VERSION = 1;
const CLOSED = Symbol("closed");

export class FilterError extends Error {
  constructor(reply) {
    const where = reply.field ? `${reply.field}: ` : "";
    const allowed = reply.allowed ? ` (allowed: ${reply.allowed})` : "";
    super(`${where}${reply.message}${allowed}`);
    this.code = reply.code;
    this.field = reply.field;
  }
}

export class FilterClient {
  // Options: timeoutMs, the timeout of a reply; name, which appears in the service's log;
  // key, { server, publicKey, secretKey }, for a service that requires one.
  constructor(endpoint, { timeoutMs = 10000, name = "filter_client.js", key } = {}) {
    this.endpoint = endpoint;
    this.timeoutMs = timeoutMs;
    this.name = name;
    this.welcome = null;
    this.profiles = new Map(); // last request of each eye, sent again to a new session
    this.nextFrameId = 0;
    this.nextProfileId = 0;
    this.waiting = []; // { accepts, resolve, reject, timer }
    this.notes = new Set(); // called with every reply
    this.socket = new Dealer({
      linger: 0,
      immediate: true,
      heartbeatInterval: 500,
      heartbeatTimeout: 2000,
      reconnectInterval: 50,
      reconnectMaxInterval: 1000,
      ...(key && {
        curveServerKey: key.server,
        curvePublicKey: key.publicKey,
        curveSecretKey: key.secretKey,
      }),
    });
    this.socket.events.on("handshake", () => this.greet());
    this.socket.events.on("disconnect", () => this.lose());
    this.socket.connect(endpoint);
    this.reading = this.read();
  }

  // Resolves with the service's welcome message.
  async hello() {
    return this.welcome ?? this.await_((reply) => reply.type === "welcome", "hello");
  }

  // Resolves when the eye is ready for all cameras; rejects with the service's error.
  async setProfile(body, { settings = {}, views = [], eye = "both" } = {}) {
    const header = {
      type: "profile",
      version: VERSION,
      profile_id: this.nextProfileId++,
      eye,
      settings,
      views: views.map(camera),
    };
    await this.hello();
    const request = [encode(header), Buffer.from(JSON.stringify(body))];
    const profile = { id: header.profile_id, request, isReady: false };
    this.profiles.set(eye, profile);
    const ours = (reply) => reply.profile_id === header.profile_id;
    const accepted = this.await_(
      (reply) => ours(reply) && reply.type === "accepted",
      "the profile to be accepted",
      ours,
    );
    // An eye may be ready before `accepted` resolves. After a lost connection, `begin` sends
    // the profile again, and counts its replies from zero.
    const isReady = (reply) => ours(reply) && reply.type === "ready";
    let missing = 0;
    let ready = null;
    const note = (reply) => {
      if (ours(reply) && reply.type === "accepted") missing = reply.n_cameras;
      if (!isReady(reply)) return;
      missing -= 1;
      ready = reply;
    };
    this.notes.add(note);
    try {
      await this.send(request);
      await accepted;
      while (missing > 0) {
        await this.await_(isReady, "the eye to be ready", ours, 12 * this.timeoutMs);
      }
      return ready;
    } finally {
      profile.isReady = true; // or has failed: `begin` need not send it for an answer
      this.notes.delete(note);
    }
  }

  // Resolves with the header of the result, whose `colors` are one image per view.
  async filter(views, look) {
    const { pupilMm, focusDpt, gazeDeg, displayTimeNs, output = "uint8", options = {} } = look;
    const end = Date.now() + this.timeoutMs;
    for (;;) {
      await this.hello();
      const frameId = this.nextFrameId++;
      const header = {
        type: "frame",
        version: VERSION,
        frame_id: frameId,
        views: views.map(described),
        pupil_diameter_mm: pupilMm,
        focus_dpt: focusDpt,
        ...(gazeDeg && { gaze_deg: gazeDeg }),
        ...(displayTimeNs !== undefined && { display_time_ns: displayTimeNs }),
        output: formatOf(output),
        options,
      };
      const ours = (reply) => reply.frame_id === frameId;
      const answer = this.await_(ours, `frame ${frameId}`, ours);
      await this.send([encode(header), ...views.flatMap(images)]);
      const reply = await answer.catch((error) => {
        const isLost = ["connection_lost", "no_session"].includes(error.code);
        if (isLost) return { reason: "connection_lost" };
        throw error;
      });
      if (reply.type === "result") return reply;
      const retries = ["preparing", "extending", "connection_lost"];
      if (!retries.includes(reply.reason) || Date.now() > end) {
        throw new FilterError({ code: reply.reason, message: `frame ${frameId} was dropped` });
      }
      await new Promise((resolve) => setTimeout(resolve, reply.retry_after_ms ?? 20));
    }
  }

  async ping() {
    await this.hello();
    const pong = this.await_((reply) => reply.type === "pong", "pong");
    await this.send([encode({ type: "ping", version: VERSION, t: 0 })]);
    return pong;
  }

  async close() {
    if (this.welcome) await this.send([encode({ type: "bye", version: VERSION })]);
    this.fail({ code: "closed", message: "the client was closed" });
    this.socket.close();
    await this.reading;
  }

  // The methods below are private.

  async greet() {
    const key = this.key ?? "";
    await this.send([
      encode({ type: "hello", version: VERSION, client: this.name, session_key: key }),
    ]);
  }

  lose() {
    this.welcome = null;
    this.fail({ code: "connection_lost", message: "the connection is lost" }, (waiting) =>
      waiting.what.startsWith("frame"),
    );
  }

  async send(parts) {
    // A Dealer allows one send at a time, so messages are chained in order.
    this.sending = (this.sending ?? Promise.resolve())
      .then(() => this.socket.send(parts))
      .catch(() => {}); // the connection is lost: `lose` rejects pending requests
    return this.sending;
  }

  async read() {
    try {
      for await (const [head, ...parts] of this.socket) {
        const reply = decode(head);
        if (reply.type === "result") reply.colors = parts.map((p, i) => picture(reply, p, i));
        if (reply.type === "welcome") await this.begin(reply);
        if (reply.type === "error" && reply.code === "no_session" && this.welcome) {
          this.welcome = null;
          await this.greet();
        }
        this.hand(reply);
      }
    } catch (error) {
      if (!this.socket.closed) this.fail({ code: "closed", message: String(error) });
    }
    return CLOSED;
  }

  async begin(welcome) {
    this.welcome = welcome;
    this.key = welcome.session_key;
    const known = { both: welcome.profile_id, ...welcome.profile_ids };
    for (const [eye, { id, request, isReady }] of this.profiles) {
      // Replies about a profile may have been lost with the connection.
      if (known[eye] !== id || !isReady) await this.send(request);
    }
  }

  await_(accepts, what, concerns = () => false, timeoutMs = this.timeoutMs) {
    return new Promise((resolve, reject) => {
      const waiting = { accepts, concerns, what, resolve, reject };
      waiting.timer = setTimeout(() => {
        this.waiting = this.waiting.filter((other) => other !== waiting);
        const message = `timed out waiting for ${what}; is there a service at ${this.endpoint}?`;
        reject(new FilterError({ code: "service_timeout", message }));
      }, timeoutMs);
      this.waiting.push(waiting);
    });
  }

  hand(reply) {
    const isError = reply.type === "error";
    for (const note of this.notes) note(reply);
    const found = this.waiting.find((waiting) =>
      isError ? waiting.concerns(reply) : waiting.accepts(reply),
    );
    if (!found) return;
    this.waiting = this.waiting.filter((other) => other !== found);
    clearTimeout(found.timer);
    if (isError) found.reject(new FilterError(reply));
    else found.resolve(reply);
  }

  fail(reply, which = () => true) {
    const failed = this.waiting.filter(which);
    this.waiting = this.waiting.filter((waiting) => !failed.includes(waiting));
    for (const waiting of failed) {
      clearTimeout(waiting.timer);
      waiting.reject(new FilterError(reply));
    }
  }
}

function camera({ widthPx, heightPx, tangents }) {
  return { width_px: widthPx, height_px: heightPx, tangents };
}

function formatOf(dtype) {
  return { dtype, space: dtype === "uint8" ? "srgb" : "linear" };
}

function described(view) {
  const dtype = view.color instanceof Float32Array ? "float32" : "uint8";
  return {
    ...camera(view),
    color: formatOf(dtype),
    depth: { kind: view.depthKind ?? "planar" },
    has_hidden: view.hiddenColor !== undefined,
    ...(view.eye && { eye: view.eye }),
    ...(view.pupilMm !== undefined && { pupil_diameter_mm: view.pupilMm }),
    ...(view.focusDpt !== undefined && { focus_dpt: view.focusDpt }),
    ...(view.gazeDeg && { gaze_deg: view.gazeDeg }),
    ...(view.pose && { pose: view.pose }),
  };
}

function bytes(array) {
  return Buffer.from(array.buffer, array.byteOffset, array.byteLength);
}

function images(view) {
  const seen = [bytes(view.color), bytes(view.depthM)];
  if (view.hiddenColor === undefined) return seen;
  return [...seen, bytes(view.hiddenColor), bytes(view.hiddenDepthM)];
}

function picture(result, part, index) {
  const { dtype } = result.views[index].color;
  if (dtype === "uint8") return new Uint8Array(part.buffer, part.byteOffset, part.byteLength);
  const copy = new Uint8Array(part); // aligned, unlike the message
  return dtype === "float32" ? new Float32Array(copy.buffer) : new Uint16Array(copy.buffer);
}
