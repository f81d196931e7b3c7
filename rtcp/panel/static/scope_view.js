// The picture of the scope: zoom by wheel, slider or keys, two cursors by clicks or keys, CSV of what is shown.
import { echarts } from "nicegui-echart";

export default {
  template: `<div><div class="scope" role="group" tabindex="0" aria-label="Signals over time" @keydown="keys"></div><p role="status">{{ cursors }}</p></div>`,
  props: { names: Object },
  data() { return { cursors: "Click into the picture to set cursors A and B. Keys: Enter sets one, arrows move it, + and - zoom." }; },
  mounted() {
    this.chart = echarts.init(this.$el.firstChild, null, { renderer: "canvas" });
    this.marks = [];
    this.paused = false;
    this.free_at = 0;
    this.stop = window.rtcp.scope((block) => { if (!this.paused) this.show(block); });
    this.sizes = new ResizeObserver(() => this.chart.resize());
    this.sizes.observe(this.$el);
    this.chart.getZr().on("click", (event) => {
      const [t] = this.chart.convertFromPixel({ gridIndex: 0 }, [event.offsetX, event.offsetY]);
      this.marks = [...this.marks, t].slice(-2);
      this.draw();
    });
  },
  beforeUnmount() { clearTimeout(this.waits); this.stop(); this.sizes.disconnect(); this.chart.dispose(); },
  methods: {
    show(block) {
      this.block = block;
      if (this.waits) return;
      // Drawing takes at most a quarter of the page's time: STOP comes first.
      this.waits = setTimeout(() => {
        this.waits = 0;
        const began = performance.now();
        this.draw();
        this.chart.getZr().flush();
        this.free_at = performance.now() + 3 * (performance.now() - began);
        this.$el.dataset.shown = String(1 + Number(this.$el.dataset.shown ?? 0));
      }, Math.max(0, this.free_at - performance.now()));
    },
    pause(value) { this.paused = value; },
    range() {
      const { t } = this.block, { start = 0, end = 100 } = this.chart.getOption().dataZoom[0];
      return [start, end].map((percent) => t[0] + (percent / 100) * (t.at(-1) - t[0]));
    },
    keys(event) {
      if (!this.block || event.ctrlKey || event.altKey || event.metaKey) return;
      const [from, to] = this.range(), middle = (from + to) / 2, last = this.marks.length - 1;
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], wider = { "+": 0.5, "-": 2 }[event.key];
      if (event.key === "Enter") this.marks = [...this.marks, middle].slice(-2);
      else if (step && this.marks.length) this.marks[last] = Math.min(to, Math.max(from, this.marks[last] + (step * (to - from)) / (event.shiftKey ? 20 : 200)));
      else if (wider) {
        const half = (wider * (to - from)) / 2, [first, end] = [this.block.t[0], this.block.t.at(-1)];
        const about = Math.min(to, Math.max(from, this.marks[last] ?? middle));
        this.chart.dispatchAction({ type: "dataZoom", startValue: Math.max(first, about - half), endValue: Math.min(end, about + half) });
      } else return;
      event.preventDefault();
      this.draw();
    },
    draw() {
      const block = this.block;
      if (!block) return;
      const dark = document.body.classList.contains("body--dark");
      const [ink, rule] = dark ? ["#f1f3f5", "#3a424b"] : ["#212529", "#d3d9df"];
      const axis = { nameTextStyle: { color: ink }, axisLine: { lineStyle: { color: ink } }, splitLine: { lineStyle: { color: rule } } };
      const lines = this.marks.map((t, at) => ({ xAxis: t, label: { formatter: "AB"[at] } }));
      this.chart.setOption({
        animation: false,
        textStyle: { color: ink },
        legend: { type: "scroll", top: 0, textStyle: { color: ink } },
        grid: { left: 60, right: 15, top: 40, bottom: 70 },
        xAxis: { ...axis, type: "value", name: "s", min: "dataMin", max: "dataMax", axisLabel: { color: ink, formatter: (t) => String(Number(t.toFixed(4))) } },
        yAxis: { ...axis, type: "value", scale: true, axisLabel: { color: ink } },
        dataZoom: [{ type: "inside" }, { type: "slider", bottom: 10 }],
        tooltip: { trigger: "axis" },
        series: block.signals.map((name, at) => ({
          name: this.names[name], type: "line", showSymbol: false, lineStyle: { width: 2 }, data: block.t.map((t, k) => [t, block.y[at][k]]),
          markLine: at === 0 ? { symbol: "none", data: lines, animation: false } : undefined,
        })),
      }, { replaceMerge: ["series"] });
      if (this.marks.length) this.cursors = this.read();
    },
    read() {
      const { t, y, signals } = this.block;
      const at = (mark) => t.reduce((best, instant, k) => (Math.abs(instant - mark) < Math.abs(t[best] - mark) ? k : best), 0);
      const [a, b] = this.marks.map(at);
      const values = (k) => signals.map((name, line) => `${this.names[name]} ${y[line][k].toPrecision(5)}`).join(", ");
      if (b === undefined) return `A ${t[a].toFixed(4)} s: ${values(a)}`;
      const change = signals.map((name, line) => `${this.names[name]} ${(y[line][b] - y[line][a]).toPrecision(4)}`).join(", ");
      return `A ${t[a].toFixed(4)} s, B ${t[b].toFixed(4)} s, B - A ${(t[b] - t[a]).toFixed(4)} s: ${change}`;
    },
    csv() {
      if (!this.block) return;
      const { t, y, signals } = this.block;
      const [from, to] = this.range();
      const rows = t.map((instant, k) => [instant, ...y.map((line) => line[k])]).filter(([instant]) => from <= instant && instant <= to);
      const lines = [["Time", ...signals], ...rows].map((row) => row.join(","));
      const link = Object.assign(document.createElement("a"), { download: "scope.csv",
        href: URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" })) });
      link.click();
      URL.revokeObjectURL(link.href);
    },
  },
};
