// Sends a few frames to a service and prints the results as JSON.
//
//     node check.js [--wait] ENDPOINT PROFILE_JSON [LEFT_JSON RIGHT_JSON]
//
// Covers mono and stereo frames, two eyes with separate profiles (PROFILE_JSON by
// default), 8-bit and linear light, and errors with their fields. With --wait, it then
// prints "lost" on a line of its own and waits for a line on stdin, so that the caller may
// break the connection. Finally it filters another frame.

import { createInterface } from "node:readline";
import { FilterClient } from "./filter_client.js";

const words = process.argv.slice(2).filter((word) => word !== "--wait");
const waits = process.argv.includes("--wait");
const [endpoint, profileText, leftText, rightText] = words;
if (profileText === undefined) {
  console.error("usage: node check.js [--wait] ENDPOINT PROFILE_JSON [LEFT_JSON RIGHT_JSON]");
  process.exit(2);
}
const widthPx = 32;
const heightPx = 18;
const tangents = [-0.5, 0.5, 0.28, -0.28];

function view(Kind, value) {
  const color = new Kind(widthPx * heightPx * 3).fill(value);
  const depthM = new Float32Array(widthPx * heightPx).fill(2);
  return { widthPx, heightPx, tangents, color, depthM };
}

const client = new FilterClient(endpoint);
const found = {};
const welcome = await client.hello();
found.session = welcome.session_id;
const camera = view(Uint8Array, 0);
found.ready = (await client.setProfile(JSON.parse(profileText), { views: [camera] })).generation;
const look = { pupilMm: 4, focusDpt: 0.5 };
const mono = await client.filter([view(Uint8Array, 10)], look);
found.mono = [mono.colors.length, mono.colors[0].length, mono.colors[0][0], mono.colors[0].at(-1)];
const pair = [view(Uint8Array, 20), view(Uint8Array, 30)];
const stereo = await client.filter(pair, look);
found.stereo = stereo.colors.map((color) => color.at(-1));
const look2 = { pupilMm: 5, focusDpt: 1, gazeDeg: [1, -2] };
for (const [eye, text] of [["left", leftText], ["right", rightText]]) {
  await client.setProfile(JSON.parse(text ?? profileText), { views: [camera], eye });
}
const pose = [0.25, 1.5, -3, 0, 0.5, 0, 0.5];
const eyes = await client.filter(
  [{ ...pair[0], eye: "left", pose }, { ...pair[1], eye: "right", ...look2 }],
  { ...look, displayTimeNs: 123 },
);
found.eyes = eyes.views.map((view, i) => [
  view.eye,
  eyes.colors[i][0],
  view.pupil_diameter_mm,
  view.focus_dpt,
  view.gaze_deg,
  view.pose ?? null,
]);
found.time = eyes.display_time_ns;
const linear = await client.filter([view(Float32Array, 0.25)], { ...look, output: "float32" });
found.linear = linear.colors[0].at(-1);
for (const [name, wrong] of [
  ["pupil", () => client.filter([camera], { pupilMm: 99, focusDpt: 0 })],
  ["profile", () => client.setProfile({ kind: "nobody" })],
  ["twoPupils", () => client.filter([pair[0], { ...pair[1], ...look2 }], look)],
]) {
  await wrong().catch((error) => {
    found[name] = [error.code, error.field];
  });
}
found.pong = (await client.ping()).n_sessions;
if (waits) {
  console.log("lost");
  await new Promise((resolve) => createInterface(process.stdin).once("line", resolve));
}
const again = await client.filter([view(Uint8Array, 10)], look);
found.again = [client.welcome.session_id, again.colors[0].at(-1)];
const both = await client.filter(
  [{ ...pair[0], eye: "left" }, { ...pair[1], eye: "right" }],
  look,
);
found.eyesAgain = both.colors.map((color) => color[0]);
await client.close();
console.log(JSON.stringify(found));
process.exit(0);
