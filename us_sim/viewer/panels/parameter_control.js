/**
 * One parameter: a slider with a number field, a choice, a switch, or a text.
 *
 * What a person sets is shown at once, sent ten times a second at most, the last for certain, and
 * until it is answered (`seen` reaches the number of the change) nothing from elsewhere moves the
 * control. After that it shows what the node has.
 */
const PAUSE = 100; // ms between two changes that are sent
const SLOW = 1000; // ms without an answer, after which that is said
const POSITIONS = 400; // of a slider that goes by factors
const DIGITS = 6;

const tidy = (number) => String(Number(Number(number).toPrecision(DIGITS)));

export default {
  template: `
    <div class="us-control" :class="{'us-refused': refusal, 'us-long-unit': unit.length > 5}"
      :title="forbidden || undefined">
      <label class="us-label" :for="field" :title="forbidden || tip">{{ label }}</label>
      <template v-if="!live">
        <span class="us-fixed">{{ text }}<span v-if="unit"> {{ unit }}</span></span>
      </template>
      <q-toggle v-else-if="kind === 'truth'" class="us-wide" dense :disable="!!forbidden" :model-value="shown"
        :aria-label="label" :aria-description="tip" @update:model-value="set($event)" />
      <q-select v-else-if="choices.length" class="us-wide" dense outlined options-dense :disable="!!forbidden"
        :for="field" :model-value="shown" :options="options" emit-value map-options
        :aria-description="tip" @update:model-value="set($event)">
        <template #option="{ itemProps, opt }">
          <q-item v-bind="itemProps" class="us-option" :aria-label="opt.label"
            :aria-description="meanings[opt.value]">
            <q-item-section>
              <q-item-label>{{ opt.label }}</q-item-label>
              <q-item-label v-if="meanings[opt.value]" caption>{{ meanings[opt.value] }}</q-item-label>
            </q-item-section>
          </q-item>
        </template>
      </q-select>
      <template v-else>
        <q-slider v-if="span" class="us-slider" :min="sliderLow" :max="sliderHigh" :disable="!!forbidden"
          :step="sliderStep" :model-value="position" :aria-label="label"
          :aria-valuetext="text + ' ' + unit" :class="{'us-none': shown === null}"
          @update:model-value="slide" @pan="pan" />
        <q-input :class="span ? 'us-field' : 'us-wide'" dense outlined :for="field" :disable="!!forbidden"
          :suffix="shown === null ? '' : unit" :model-value="typed === null ? text : typed"
          :placeholder="optional ? 'none' : ''" :aria-label="label" :aria-description="tip"
          :inputmode="isNumber ? 'decimal' : 'text'" autocomplete="off" spellcheck="false"
          @update:model-value="typed = $event" @keydown="key" @blur="take" />
      </template>
      <div v-if="meanings[shown]" class="us-meaning">{{ meanings[shown] }}</div>
      <div v-if="isSlow" class="us-meaning" role="status">waiting for the node to take it …</div>
      <div v-if="refusal" class="us-reason" role="alert">{{ refusal }}</div>
    </div>`,
  props: {
    label: String,
    kind: String,
    value: null,
    unit: { type: String, default: "" },
    span: { type: Object, default: null }, // low, high, step, is_logarithmic
    choices: { type: Array, default: () => [] },
    meanings: { type: Object, default: () => ({}) }, // of choices, in words
    optional: Boolean, // nothing is a value, too: null
    live: Boolean,
    tip: { type: String, default: "" },
    forbidden: { type: String, default: "" }, // why nothing may be set from this page
    reason: { type: String, default: "" }, // why the change of number `seen` was refused
    seen: { type: Number, default: 0 },
  },
  emits: ["change"],
  data() {
    return {
      local: null,
      sent: 0,
      isDragged: false,
      isWaiting: false,
      typed: null,
      wrong: "",
      isSlow: false, // no answer has come for a while
      held: null, // the span while it is dragged
    };
  },
  computed: {
    field() {
      return `us-field-${this.$.uid}`;
    },
    isNumber() {
      return this.kind === "number" || this.kind === "whole";
    },
    isPending() {
      return this.isDragged || this.isWaiting || this.sent > this.seen;
    },
    shown() {
      return this.isPending ? this.local : this.value;
    },
    refusal() {
      return this.wrong || (this.isPending ? "" : this.reason);
    },
    text() {
      if (this.shown === null || this.shown === undefined) return this.live ? "" : "none";
      if (Array.isArray(this.shown)) {
        return this.shown.map((each) => (this.kind === "texts" ? each : tidy(each))).join(", ");
      }
      if (this.kind === "truth") return this.shown ? "yes" : "no";
      return this.isNumber ? tidy(this.shown) : String(this.shown);
    },
    options() {
      const options = this.choices.map((choice) => ({ label: choice, value: choice }));
      return this.optional ? [{ label: "none", value: null }, ...options] : options;
    },
    scale() {
      return this.held || this.span;
    },
    sliderLow() {
      return this.scale.is_logarithmic ? 0 : this.scale.low;
    },
    sliderHigh() {
      return this.scale.is_logarithmic ? POSITIONS : this.scale.high;
    },
    sliderStep() {
      return this.scale.is_logarithmic ? 1 : this.scale.step;
    },
    position() {
      const { low, high, is_logarithmic } = this.scale;
      const value = Math.min(Math.max(this.shown ?? low, low), high);
      return is_logarithmic ? (POSITIONS * Math.log(value / low)) / Math.log(high / low) : value;
    },
  },
  watch: {
    seen() {
      clearTimeout(this.waiting);
      this.isSlow = false;
    },
  },
  beforeUnmount() {
    clearTimeout(this.waiting);
    if (this.isWaiting && this.timer) this.send();
    clearTimeout(this.timer);
  },
  methods: {
    slide(position) {
      const { low, high, is_logarithmic, step } = this.scale;
      let value = position;
      if (is_logarithmic) {
        value = Number((low * (high / low) ** (position / POSITIONS)).toPrecision(3));
      } else if (this.kind !== "whole") {
        value = Number((Math.round(position / step) * step).toPrecision(10));
      }
      this.set(Math.min(Math.max(value, low), high));
    },
    pan(phase) {
      this.isDragged = phase === "start";
      this.held = this.isDragged ? { ...this.span } : null;
    },
    set(value) {
      this.wrong = "";
      this.typed = null;
      this.local = value;
      if (this.isWaiting) return;
      this.isWaiting = true;
      const since = performance.now() - (this.last ?? -PAUSE);
      this.timer = setTimeout(this.send, Math.max(0, PAUSE - since));
    },
    send() {
      this.timer = null;
      this.last = performance.now();
      this.isWaiting = false;
      this.sent = Math.max(this.sent, this.seen) + 1;
      clearTimeout(this.waiting);
      this.waiting = setTimeout(() => (this.isSlow = this.sent > this.seen), SLOW);
      this.$emit("change", { value: this.local, turn: this.sent });
    },
    key(event) {
      if (event.key === "Enter") {
        this.take();
      } else if (event.key === "Escape" && this.typed !== null) {
        this.typed = null;
        this.wrong = "";
        event.stopPropagation();
      } else if (this.isNumber && this.span && ["ArrowUp", "ArrowDown"].includes(event.key)) {
        event.preventDefault();
        const up = event.key === "ArrowUp" ? 1 : -1;
        const by = this.scale.is_logarithmic ? 4 : this.sliderStep;
        const to = this.position + up * by * (event.shiftKey ? 10 : 1);
        this.slide(Math.min(Math.max(to, this.sliderLow), this.sliderHigh));
      }
    },
    take() {
      if (this.typed === null || this.typed === this.text) {
        this.typed = null;
        return;
      }
      const written = this.typed.trim();
      if (written === "" && this.optional) return this.set(null);
      if (this.kind === "text") return this.set(written);
      if (!this.isNumber) {
        const items = written.split(",").map((each) => each.trim());
        return this.set(items.filter((each) => each !== ""));
      }
      const number = Number(written.replace(",", "."));
      if (written === "" || !Number.isFinite(number)) {
        this.wrong = written ? `'${written}' is not a number` : `${this.label} needs a number`;
        this.typed = null;
        return;
      }
      this.set(number);
    },
  },
};
