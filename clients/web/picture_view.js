// The scene and the filtered picture, or states A and B, left and right of a split.
//
// Pictures arrive over a separate websocket as a JSON header and an encoded image.  Only
// the newest is drawn; `window.ocufilter.drawn` lists what was drawn, and when.
const SPLIT_STEPS = { ArrowLeft: -2, ArrowDown: -2, ArrowRight: 2, ArrowUp: 2,
  PageDown: -20, PageUp: 20, Home: -100, End: 100 }; // percent
const POINT_MS = 90; // between two reports of the pointer position
const RECONNECT_MS = 1000;
const LINE_PX = 16; // height of a label beside a row of the chart
const LABELS_EM = 7; // width of the labels, in their own font size
const NARROW_EM = 3.6; // less, if only one notation is shown
const FRACTION_EM = 1.4; // by which fractions such as 20/200 are wider
const LEAST_LINE_PX = 11; // smaller labels are illegible; only the caption is shown

export default {
  template: `
    <div class="oc-stage" ref="stage">
      <div class="oc-views" :class="{ 'oc-two': views.length > 1 }">
        <div v-for="{ eye, left } in views" :key="eye + left" class="oc-eye-view">
          <div class="oc-view" :class="{ 'oc-empty': isEmpty, 'oc-chart': marks.length }" :data-eye="eye"
               :style="frame"
               @pointermove="onMove($event, eye)" @pointerdown="onDown($event, eye)"
               @pointerup="onUp($event, eye)" @pointercancel="dragging = false">
            <canvas :ref="left + '/' + eye" class="oc-before" role="img"
                    :aria-label="left === 'scene' ? 'Scene: ' + scene : alts[left] || label(left)"></canvas>
            <canvas :ref="eye + '/' + eye" class="oc-after" :style="clip" role="img"
                    :aria-label="alts[eye] || label(eye)"></canvas>
            <canvas v-if="left !== 'scene'" v-show="held === 'scene'" :ref="'scene/' + eye" class="oc-under"
                    role="img" :aria-label="'Scene: ' + scene"></canvas>
            <template v-if="labels.length">
              <svg class="oc-leaders" :style="left === 'scene' ? clip : {}" aria-hidden="true">
                <line v-for="mark in labels" :x1="100 * mark.x + 1 + '%'" :y1="100 * mark.y + '%'"
                      :x2="labelsStart" :y2="mark.top + line / 2"></line>
              </svg>
              <ol class="oc-marks" :class="{ 'oc-fractions': hasFractions, 'oc-narrow': isNarrow }" :style="{ ...(left === 'scene' ? clip : {}), fontSize: 0.75 * line + 'px', lineHeight: line + 'px' }">
                <li class="oc-marks-head"><template v-for="head in columns(marks_head)"><span>{{ head }}</span>{{ " " }}</template></li>
                <li v-for="mark in labels" :style="{ top: mark.top + 'px' }"
                    :class="{ 'oc-read': readers(mark, eye, left).length }"
                    ><b v-if="left !== 'scene'">{{ readers(mark, eye, left).map(label).join(" ") + " " }}</b
                    ><template v-for="text in columns(mark.texts)"><span>{{ text }}</span>{{ " " }}</template></li>
              </ol>
            </template>
            <span class="oc-tag oc-tag-left" :style="{ opacity: whole || shownSplit > 12 ? 1 : 0 }">
              {{ held === "scene" ? "Scene" : whole ? label(eye) : left === "scene" ? "Scene" : label(left) }}</span>
            <span v-if="!whole" class="oc-tag oc-tag-right" :style="rightTag">
              {{ label(eye) }}</span>
            <span class="oc-state" :class="'oc-' + state(eye).kind" :key="state(eye).text">{{ state(eye).text }}</span>
            <span v-if="point && point.eye === eye" class="oc-cross"
                  :style="{ left: 100 * point.x + '%', top: 100 * point.y + '%' }"></span>
            <div v-if="!whole" class="oc-split" :style="{ left: shownSplit + '%' }" role="slider" tabindex="0"
                 :aria-label="splitName(eye, left)"
                 aria-valuemin="0" aria-valuemax="100" :aria-valuenow="Math.round(split)"
                 :aria-valuetext="Math.round(split) + ' % ' + (left === 'scene' ? 'scene' : label(left))"
                 @keydown="onKey"><i :style="{ top: knobTop }"></i></div>
          </div>
          <div v-if="!isEmpty" class="oc-captions">
            <template v-for="name in left === 'scene' ? [eye] : [left, eye]">
              <p v-if="captions[name]" class="oc-caption">{{ label(name) }}: {{ captions[name] }}</p>
            </template>
          </div>
        </div>
      </div>
      <slot name="told"></slot>
      <div class="oc-view-tools">
        <button v-for="name in holdable" type="button" class="oc-tool" @pointerdown="hold(name)"
                @pointerup="hold('')" @pointercancel="hold('')" @contextmenu.prevent
                @pointerleave="hold('')" @keydown.space.prevent="hold(name)"
                @keyup.space="hold('')" @keydown.enter.prevent="hold(name)"
                @keyup.enter="hold('')" @blur="hold('')" :aria-pressed="held === name"
                >Hold to see {{ name === "scene" ? "the scene" : label(name) }}</button>
        <button type="button" class="oc-tool" title="Esc leaves it" @click="fill">Full screen</button>
        <slot></slot>
      </div>
    </div>`,
  props: { address: String, eyes: Array, labels_of: Object, behind_one: Boolean, whole: Boolean, aspect: Number,
    scene: String, alts: Object, marks: Array, marks_head: Array, captions: Object, empty: String },
  data() {
    return { hasScene: false, height: 0, width: 0, split: 50, held: "", dragging: false, point: null, states: {}, down: null };
  },
  computed: {
    frame() {
      return { aspectRatio: this.aspect, maxWidth: `calc(var(--tallest) * var(--share) * ${this.aspect})` };
    },
    views() { // what is left and right of each split
      if (this.behind_one) return [{ eye: this.eyes[1], left: this.eyes[0] }];
      return this.eyes.map((eye) => ({ eye, left: "scene" }));
    },
    holdable() {
      return this.behind_one ? [...this.eyes, "scene"] : ["scene"];
    },
    shownSplit() {
      if (!this.held) return this.whole ? 0 : this.split;
      return this.behind_one && this.held === this.eyes[1] ? 0 : 100;
    },
    clip() {
      return { clipPath: `inset(0 0 0 ${this.shownSplit}%)` };
    },
    rightTag() { // beside the split of a chart, whose right edge has the labels
      const opacity = this.shownSplit < 88 ? 1 : 0;
      if (!this.marks.length) return { opacity };
      return { opacity, right: "auto", left: `calc(${this.shownSplit}% + 40px)` };
    },
    knobTop() { // between the first rows of a chart, unless one of them is marked
      const [first, second] = this.marks;
      if (!second || first.eyes.length || second.eyes.length) return "50%";
      return `${50 * (first.y + second.y)}%`;
    },
    isEmpty() {
      return !this.hasScene || Boolean(this.empty);
    },
    line() {
      return Math.min(LINE_PX, this.height / (this.marks.length + 1));
    },
    hasFractions() {
      return this.marks.some((mark) => mark.texts.at(-1).includes("/"));
    },
    isNarrow() { // both notations would lie over the letters
      const lettersEnd = Math.max(...this.marks.map((mark) => mark.x)) * this.width;
      return this.marks_head.length > 1 && this.startOf(LABELS_EM) < lettersEnd;
    },
    labelsStart() { // px from the left to the labels
      return this.startOf(LABELS_EM - (this.isNarrow ? NARROW_EM : 0));
    },
    labels() {
      // beside their rows; moved up or down where rows are closer than lines
      if (this.isEmpty || this.line < LEAST_LINE_PX) return [];
      const tops = [];
      let next = this.line; // below the headings
      for (const mark of this.marks) {
        tops.push(Math.max(mark.y * this.height - this.line / 2, next));
        next = tops.at(-1) + this.line;
      }
      let last = this.height;
      for (let k = tops.length - 1; k >= 0; k--) {
        last = Math.min(tops[k], last - this.line);
        tops[k] = last;
      }
      return this.marks.map((mark, k) => ({ ...mark, top: tops[k] }));
    },
  },
  created() {
    this.latest = {}; // the newest message of each slot, for canvases created later
    this.queue = Promise.resolve();
    window.ocufilter = { drawn: [], split: () => this.split };
  },
  mounted() {
    this.connect();
    this.sizes = new ResizeObserver(() => this.measure());
    this.sizes.observe(this.$el);
  },
  beforeUnmount() {
    this.ended = true;
    this.sizes.disconnect();
    this.socket?.close();
  },
  watch: {
    views() {
      this.$nextTick(() => {
        this.measure();
        Object.values(this.latest).forEach((m) => this.drawNext(m));
      });
    },
  },
  methods: {
    label(eye) {
      return this.labels_of[eye] ?? "";
    },
    startOf(labels_em) {
      const all_em = labels_em + (this.hasFractions ? FRACTION_EM : 0);
      return Math.max(0, this.width - all_em * 0.75 * this.line - 4);
    },
    columns(texts) {
      return this.isNarrow ? texts.slice(-1) : texts;
    },
    splitName(eye, left) {
      if (left !== "scene") return `Split between ${this.label(left)} and ${this.label(eye)}`;
      return `Split between the scene and the ${this.label(eye).toLowerCase()}`;
    },
    readers(mark, eye, left) { // states whose smallest row this is
      return [left, eye].filter((name) => mark.eyes.includes(name));
    },
    measure() {
      const view = this.$el.querySelector(".oc-view");
      this.height = view?.clientHeight;
      this.width = view?.clientWidth;
    },
    state(eye) {
      if (this.empty) return { kind: "wait", text: this.empty };
      const waiting = this.hasScene ? "Preparing…" : "Rendering the scene…";
      return this.states[eye] ?? { kind: "wait", text: waiting };
    },
    connect() {
      const scheme = location.protocol === "https:" ? "wss:" : "ws:";
      this.socket = new WebSocket(`${scheme}//${location.host}${this.address}`);
      this.socket.binaryType = "arraybuffer";
      this.socket.onmessage = (event) => this.take(event.data);
      this.socket.onclose = () => {
        if (!this.ended) setTimeout(() => this.connect(), RECONNECT_MS);
      };
    },
    take(buffer) {
      const length = new DataView(buffer).getUint32(0, true);
      const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
      const message = { header, data: buffer.slice(4 + length) };
      if (header.eye && header.number < this.latest.scene?.header.number) return;
      this.latest[header.eye ?? "scene"] = message;
      this.drawNext(message);
    },
    drawNext(message) {
      this.queue = this.queue.then(() => this.draw(message));
    },
    async draw(message) {
      const { header, data } = message;
      const slot = header.eye ?? "scene";
      if (this.latest[slot] !== message) return; // a newer one has arrived
      if (header.kind === "failed") {
        this.states[slot] = { kind: "failed", text: header.error };
        return;
      }
      const bitmap = await createImageBitmap(new Blob([data]));
      if (this.latest[slot] !== message) return bitmap.close();
      for (const { eye } of this.views) {
        const canvas = this.$refs[`${slot}/${eye}`]?.[0];
        if (!canvas) continue;
        canvas.width = bitmap.width;
        canvas.height = bitmap.height;
        canvas.getContext("2d").drawImage(bitmap, 0, 0);
      }
      bitmap.close();
      if (!header.eye) {
        this.hasScene = true;
        return this.clear();
      }
      const text = header.kind === "full" ? `Full picture · ${header.width_px} × ${header.height_px}` : "Preview";
      this.states[slot] = { kind: header.kind, text };
      const drawn = window.ocufilter.drawn;
      drawn.push({ ...header, at_ms: performance.now() });
      if (drawn.length > 500) drawn.shift();
    },
    clear() {
      // remove filtered pictures of the previous scene
      for (const eye of this.eyes) {
        const message = this.latest[eye];
        if (message && message.header.number >= this.latest.scene.header.number) continue;
        for (const view of this.views) {
          const canvas = this.$refs[`${eye}/${view.eye}`]?.[0];
          if (canvas) canvas.width = canvas.width;
        }
        delete this.latest[eye];
        delete this.states[eye];
      }
    },
    position(event) {
      const box = event.currentTarget.getBoundingClientRect();
      const clamp = (value) => Math.min(Math.max(value, 0), 1);
      return {
        x: clamp((event.clientX - box.left) / box.width),
        y: clamp((event.clientY - box.top) / box.height),
      };
    },
    onDown(event, eye) {
      const { x } = this.position(event);
      const box = event.currentTarget.getBoundingClientRect();
      this.down = { x: event.clientX, y: event.clientY };
      if (!this.whole && Math.abs(x - this.split / 100) * box.width < 22) {
        this.dragging = true;
        event.currentTarget.setPointerCapture(event.pointerId);
        event.preventDefault();
      }
    },
    onMove(event, eye) {
      const { x, y } = this.position(event);
      if (this.dragging) this.split = 100 * x;
      else if (!this.isEmpty) this.report(eye, x, y);
    },
    onUp(event, eye) {
      const moved = this.down && Math.hypot(event.clientX - this.down.x, event.clientY - this.down.y);
      const { x, y } = this.position(event);
      if (!this.dragging && !this.isEmpty && this.down && moved < 5) this.$emit("look", { eye, x, y });
      this.dragging = false;
      this.down = null;
    },
    onKey(event) {
      const step = SPLIT_STEPS[event.key];
      if (!step) return;
      this.split = Math.min(Math.max(this.split + step, 0), 100);
      event.preventDefault();
    },
    hold(isHeld) {
      this.held = isHeld;
    },
    fill() {
      if (document.fullscreenElement) document.exitFullscreen();
      else this.$refs.stage.requestFullscreen();
    },
    report(eye, x, y) {
      this.point = { eye, x, y };
      if (this.reporting) return;
      this.reporting = setTimeout(() => {
        this.reporting = null;
        this.$emit("point", this.point);
      }, POINT_MS);
    },
  },
};
