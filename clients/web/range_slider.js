// A native range input, so that the browser provides its role, keys and touch.
//
// It keeps its own value until the server has answered its last report, so that the
// response to an older value does not move it back.
const THROTTLE_MS = 30; // between two reported values
const PAGE_STEPS = 10; // steps of a Page key

export default {
  template: `
    <div class="oc-slider" :class="{ 'oc-off': disabled }">
      <div v-if="text" class="oc-slider-head">
        <label :for="id">{{ label }}</label>
        <input v-if="typing" ref="typed" type="text" class="oc-typed" :aria-label="label + ', typed'"
               :value="text" @keydown.enter="take" @keydown.esc="leave" @blur="take">
        <template v-else>
          <span class="oc-value" aria-hidden="true">{{ text }}</span>
          <button type="button" ref="pencil" class="oc-type" :disabled="disabled" :aria-label="'Type ' + label"
                  @click="type">✎</button>
        </template>
      </div>
      <input type="range" :id="id" :data-name="name" :min="min" :max="max" :step="step"
             :value="current" :disabled="disabled" :aria-label="text ? null : label"
             :aria-valuetext="text || null" @input="onInput" @keydown="onKey">
    </div>`,
  props: {
    name: String, label: String, text: String, min: Number, max: Number,
    step: Number, value: Number, answered: Number, disabled: Boolean,
  },
  data() {
    return {
      current: this.value,
      typing: false,
      sent: this.answered, // number of the last report
      id: `oc-range-${Math.random().toString(36).slice(2)}`,
    };
  },
  watch: {
    value() { this.follow(); },
    answered() { this.follow(); },
  },
  methods: {
    follow() {
      if (!this.waiting && this.answered >= this.sent) this.current = this.value;
    },
    onInput(event) {
      this.current = Number(event.target.value);
      this.report();
    },
    type() {
      this.typing = true;
      this.$nextTick(() => this.$refs.typed.select());
    },
    take(event) {
      if (!this.typing) return; // Enter also takes the focus away
      const { value } = event.target;
      if (event.type === "blur") this.typing = false;
      else {
        event.preventDefault(); // else Enter would press the button that gets the focus
        this.leave();
      }
      if (value !== this.text) this.$emit("typed", value);
    },
    leave() { // by a key: the focus stays at this number
      this.typing = false;
      this.$nextTick(() => this.$refs.pencil?.focus());
    },
    onKey(event) {
      const steps = { PageUp: PAGE_STEPS, PageDown: -PAGE_STEPS }[event.key];
      if (!steps) return;
      event.preventDefault();
      const next = this.current + steps * this.step;
      const rounded = this.min + Math.round((next - this.min) / this.step) * this.step;
      this.current = Math.min(Math.max(rounded, this.min), this.max);
      this.report();
    },
    report() {
      if (this.waiting) return;
      this.sent += 1;
      this.$emit("move", [this.current, this.sent]);
      const reported = this.current;
      this.waiting = setTimeout(() => {
        this.waiting = null;
        if (this.current !== reported) this.report();
        else this.follow();
      }, THROTTLE_MS);
    },
  },
};
