// A client written from PROTOCOL.md alone: prints a line for every filtered frame.
//
//     node minimal_client.js ENDPOINT WIDTH_PX HEIGHT_PX PROFILE_JSON
//
// Run it in a folder with the packages `zeromq` and `@msgpack/msgpack`.

import { createRequire } from "node:module";

const require = createRequire(`${process.cwd()}/`);
const { decode, encode } = require("@msgpack/msgpack");
const { Dealer } = require("zeromq");

const SILENCE_MS = 2000;
const PROFILE_ID = 1;

const [endpoint, width, height, profile] = process.argv.slice(2);
const view = {
  width_px: Number(width),
  height_px: Number(height),
  tangents: [-0.5, 0.5, 0.28, -0.28],
};
const pixels = view.width_px * view.height_px;
const images = [Buffer.alloc(3 * pixels), Buffer.alloc(4 * pixels)]; // depth 0 is missing

const socket = new Dealer({
  linger: 0,
  immediate: true,
  sendTimeout: 0,
  heartbeatInterval: 500,
  heartbeatTimeout: 2000,
});
socket.connect(endpoint);

let isGreeting = true;
let sessionKey = "";
let unanswered = 0;
let frameId = 0;
let activeMs = 0; // time of the last message received or sent
let nextFrameMs = 0;
let sending = Promise.resolve(); // one message at a time

function send(header, ...parts) {
  // Without a connection, a message is lost.
  const message = [encode({ ...header, version: 1 }), ...parts];
  const sent = () => (activeMs = Date.now());
  sending = sending.then(() => socket.send(message).then(sent, () => {}));
}

function greet() {
  isGreeting = true;
  send({ type: "hello", session_key: sessionKey });
}

function sendProfile() {
  const header = { type: "profile", profile_id: PROFILE_ID, views: [view] };
  send(header, Buffer.from(profile));
}

function act() {
  const now = Date.now();
  if ((isGreeting || unanswered > 0) && now - activeMs > SILENCE_MS) greet();
  if (isGreeting || unanswered > 0 || now < nextFrameMs) return;
  frameId += 1;
  unanswered += 1; // if it cannot be sent, the silence is noticed
  send(
    {
      type: "frame",
      frame_id: frameId,
      views: [{ ...view, color: { dtype: "uint8", space: "srgb" } }],
      pupil_diameter_mm: 4,
      focus_dpt: 0,
    },
    ...images,
  );
}

function handle(reply) {
  if (reply.type === "alive") return;
  activeMs = Date.now();
  if ("frame_id" in reply) {
    unanswered = Math.max(0, unanswered - 1);
    nextFrameMs = activeMs + (reply.retry_after_ms ?? 0);
  }
  if (reply.type === "result") {
    console.log(reply.frame_id);
  } else if (reply.type === "welcome") {
    sessionKey = reply.session_key;
    unanswered = reply.n_unanswered ?? 0;
    const isKnown = Object.values(reply.profile_ids).includes(PROFILE_ID);
    if (!(reply.is_resumed && isKnown)) sendProfile();
    isGreeting = false;
  } else if (reply.code === "no_session") {
    if (!isGreeting) greet();
  } else if (["no_profile", "worker_crashed"].includes(reply.code)) {
    sendProfile();
  } else if (reply.type === "error" && "profile_id" in reply) {
    if (reply.code !== "build_cancelled") throw new Error(`${reply.code}: ${reply.message}`);
  }
}

setInterval(act, 50);
for await (const [header] of socket) {
  handle(decode(header));
  act();
}
