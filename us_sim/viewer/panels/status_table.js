/** Every node in a row: rate in Hz, latency in ms, messages; colour only for what is wrong. */
export default {
  template: `
    <table class="us-status">
      <thead>
        <tr>
          <th scope="col">node</th>
          <th scope="col" title="messages that it publishes each second">rate<br>Hz</th>
          <th scope="col" title="age of what it publishes: median, and 99 of 100 are younger">
            latency<br>p50 · p99 ms
          </th>
          <th scope="col" title="messages that came, and those skipped for newer ones">
            in<br>skipped
          </th>
        </tr>
      </thead>
      <tbody v-for="row in rows" :key="row.name" :class="'us-level-' + row.level">
        <tr>
          <th scope="row">
            <button type="button" @click="$emit('choose', row.name)"
              :title="'Parameters of ' + row.name">{{ row.name }}</button>
            <div class="us-state">{{ row.state }}</div>
          </th>
          <td>{{ row.rate }}</td>
          <td>{{ row.latency }}</td>
          <td>{{ row.received }}<br>{{ row.dropped }}</td>
        </tr>
        <tr v-if="row.problem" class="us-problem" :class="{'us-past': row.isPast}">
          <td colspan="4">{{ row.problem }}</td>
        </tr>
      </tbody>
    </table>
    <p v-if="!rows.length" class="us-note">No node has said anything yet.</p>`,
  emits: ["choose"],
  props: { rows: { type: Array, default: () => [] } },
};
