/** Gain by depth: sliders across, one below the other as the depths are, as consoles have them. */
const PAUSE = 100; // ms between two changes that are sent

export default {
  template: `
    <div class="us-time-gain" role="group" :aria-label="label" :aria-description="tip"
      :title="forbidden || undefined">
      <div class="us-time-gain-head">
        <span class="us-label" :title="tip">{{ label }}</span>
        <button type="button" class="us-level" :disabled="isFlat || !!forbidden" @click="flatten"
          title="the same gain at all depths: 0 dB">level</button>
      </div>
      <div v-for="(gain, i) in shown" :key="i" class="us-gain">
        <span class="us-depth">{{ depths[i] }}</span>
        <q-slider :disable="!!forbidden" :min="low" :max="high" :step="0.5" :inner-min="low" :model-value="gain"
          selection-color="transparent" :aria-label="label + ' at ' + depths[i]"
          :aria-valuetext="gain + ' ' + unit" @pan="isDragged = $event === 'start'"
          @update:model-value="slide(i, $event)" />
        <span class="us-decibels">{{ gain.toFixed(1) }} {{ unit }}</span>
      </div>
      <div v-if="reason && !isPending" class="us-reason" role="alert">{{ reason }}</div>
    </div>`,
  props: {
    label: String,
    gains: Array, // dB, from the face to the end of the beams
    depths: Array, // texts, beside the sliders
    unit: String,
    low: Number,
    high: Number,
    tip: String,
    forbidden: { type: String, default: "" }, // why nothing may be set from this page
    reason: { type: String, default: "" },
    seen: { type: Number, default: 0 },
  },
  emits: ["change"],
  data: () => ({ local: [], sent: 0, isWaiting: false, isDragged: false }),
  computed: {
    isPending() {
      return this.isDragged || this.isWaiting || this.sent > this.seen;
    },
    shown() {
      return this.isPending && this.local.length ? this.local : this.gains;
    },
    isFlat() {
      return this.shown.every((gain) => gain === 0);
    },
  },
  beforeUnmount() {
    if (this.isWaiting) this.send();
    clearTimeout(this.timer);
  },
  methods: {
    slide(i, gain) {
      const gains = [...this.shown];
      gains[i] = gain;
      this.set(gains);
    },
    flatten() {
      this.set(this.shown.map(() => 0));
    },
    set(gains) {
      this.local = gains;
      if (this.isWaiting) return;
      this.isWaiting = true;
      const since = performance.now() - (this.last ?? -PAUSE);
      this.timer = setTimeout(this.send, Math.max(0, PAUSE - since));
    },
    send() {
      clearTimeout(this.timer);
      this.last = performance.now();
      this.isWaiting = false;
      this.sent = Math.max(this.sent, this.seen) + 1;
      this.$emit("change", { value: this.local, turn: this.sent });
    },
  },
};
