// What every page does: it shows the state, answers it, and sends the operator's input. The socket and its tokens:
// rtcp/panel/live.py.
"use strict";
window.rtcp = (() => {
  const STALE_MS = 500; // time without a message after which the page says so
  const OLD_S = 0.5; // joint values older than this are marked; a bar that comes and goes would move the buttons
  let socket = null, token = 0, heard = 0, state = {}, connected = false;
  const listeners = new Set(), pictures = new Set();
  function kept(read) { try { return read(); } catch { return null; } } // a browser may block its storage

  // -- the socket ------------------------------------------------------------------------------------------------------

  function connect() {
    const url = new URL("/live", location.href);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    url.searchParams.set("page", pageKey());
    socket = new WebSocket(url);
    socket.onmessage = (event) => receive(JSON.parse(event.data));
    socket.onclose = () => { token = 0; release(); setTimeout(connect, 500); };
  }
  function pageKey() { return document.querySelector("[data-page]")?.dataset.page ?? ""; }
  function send(message) {
    if (socket?.readyState === WebSocket.OPEN && socket.bufferedAmount < 4096) {
      socket.send(JSON.stringify({ seen: token, visible: !document.hidden, ...message }));
    }
  }
  function receive(message) {
    if (message.scope) {
      for (const picture of pictures) picture(message.scope);
      return;
    }
    const now = performance.now();
    // After a stall of this page, keys pressed before it are ignored.
    if (heard && now - heard > 200) release();
    heard = now;
    token = message.token;
    state = message;
    gamepad();
    send(pressed.size || pad ? jogMessage() : {});
    for (const note of message.notes) say(note);
    show();
    for (const listener of listeners) listener(message);
  }
  function say(text) {
    const box = document.getElementById("notes");
    if (!box) return;
    const line = document.createElement("div");
    line.textContent = text;
    box.append(line);
    while (box.childElementCount > 3) box.firstChild.remove();
    setTimeout(() => line.remove(), 6000);
  }

  // -- showing ---------------------------------------------------------------------------------------------------------

  const STATES = { 0x00: "not ready", 0x40: "switch-on disabled", 0x21: "ready to switch on", 0x23: "switched on",
    0x27: "operation enabled", 0x07: "quick stop", 0x0f: "fault reaction", 0x08: "fault" };
  function drive(word) { return STATES[(word & 0x4f) in STATES && (word & 0x4f) !== 0x07 ? word & 0x4f : word & 0x6f] ?? "?"; }
  function put(element, text) { if (element.textContent !== text) element.textContent = text; }

  // Values are SI everywhere; what a person reads and types is in the units that this browser keeps.
  const UNITS = { rad: { rad: 1, deg: 180 / Math.PI }, m: { m: 1, mm: 1000 } };
  const chosen = { rad: "rad", m: "m", ...kept(() => JSON.parse(localStorage.getItem("rtcp-units"))) };
  function unit(si) { // the shown unit for a unit of the interfaces, and the factor between them
    const [base, ...rest] = si.split("/"), name = Object.hasOwn(chosen, base) ? chosen[base] : "";
    return name ? [[name, ...rest].join("/"), UNITS[base][name] ?? 1] : [si, 1];
  }
  function figure(value, { in: si = "", digits }) {
    const factor = unit(si)[1], fewer = Math.round(Math.log10(factor));
    return digits ? (value * factor).toFixed(Math.max(0, digits - fewer)) : String(factor === 1 ? value : +(value * factor).toPrecision(5));
  }
  function isNumber(text) { return text.trim() !== "" && Number.isFinite(+text); }
  function measure(field) { // show the value of a field in the chosen unit
    const factor = unit(field.dataset.in)[1], before = +(field.dataset.factor ?? 1);
    if (field.dataset.factor === String(factor)) return;
    field.dataset.factor = factor;
    for (const key of ["min", "max", "step"]) {
      const bound = parseFloat(field.getAttribute(key));
      if (Number.isFinite(bound)) field.setAttribute(key, +((bound * factor) / before).toPrecision(9));
    }
    write(field, field.dataset.si ?? field.value);
  }
  function write(field, si) {
    if (!field.dataset.in) { field.value = si; return; }
    field.dataset.si = si;
    field.value = isNumber(si) && unit(field.dataset.in)[1] !== 1 ? figure(+si, { in: field.dataset.in }) : si;
  }
  function typed(field) { // what somebody has typed, SI
    const { value, dataset } = field, factor = dataset.in ? unit(dataset.in)[1] : 1;
    const si = factor !== 1 && isNumber(value) ? String(+value / factor) : value;
    if (dataset.in) dataset.si = si;
    return si;
  }
  function showUnits(which = ":not([data-measured])") { // of the elements added since
    const selectors = ["[data-unit]", "[data-si]", "input[data-in]", "[data-units]"].map((kind) => kind + which);
    for (const element of document.querySelectorAll(selectors.join())) {
      const { unit: of, units, si } = element.dataset;
      if (of) put(element, unit(of)[0]);
      else if (units) element.value = chosen[units];
      else if (element.tagName === "INPUT") measure(element);
      else put(element, figure(+si, element.dataset));
      element.dataset.measured = "";
    }
  }
  document.addEventListener("change", (event) => {
    const of = event.target.dataset?.units;
    if (!of) return;
    chosen[of] = event.target.value;
    kept(() => localStorage.setItem("rtcp-units", JSON.stringify(chosen)));
    showUnits("");
    show();
  });

  function show() {
    const connectedNow = performance.now() - heard < STALE_MS;
    if (connectedNow !== connected) {
      connected = connectedNow;
      document.body.classList.toggle("stale", !connected);
    }
    const joints = state.joints;
    for (const element of document.querySelectorAll("[data-live]")) {
      const [name, ...path] = element.dataset.live.split("."), index = path[0];
      let value = connected ? state[name] : undefined;
      if (joints && name in joints) value = joints[name][index];
      else if (name === "error" && joints) value = joints.commanded_position[index] - joints.actual_position[index];
      else if (name === "drive" && state.statuswords) value = drive(state.statuswords[index]);
      else for (const key of path) value = value?.[key];
      const isState = element.dataset.live.endsWith("state");
      if (!connected) value = isState ? "no connection" : undefined;
      const empty = value === undefined || value === null || value === "";
      const label = empty ? "–" : typeof value === "number" ? figure(value, element.dataset) : String(value);
      put(element, (isState ? label.replaceAll("_", " ") : label) + (empty ? "" : element.dataset.suffix ?? ""));
      if (isState) element.dataset.state = String(value);
      else if (name === "drive") element.dataset.value = label;
    }
    showUnits();
    for (const element of document.querySelectorAll("[data-bar]")) {
      const [name, index] = element.dataset.bar.split(".");
      const value = connected && joints ? joints[name][index] : NaN;
      const ends = element.dataset.limits.split(" ").map((limit) => state.limits?.[limit]?.[index] ?? NaN);
      const [low, high] = ends.length > 1 ? ends : [-ends[0], ends[0]];
      const [unitName, factor] = unit(element.dataset.in), bound = (value) => +(value * factor).toPrecision(4);
      const title = Number.isFinite(low + high) ? `${bound(low)} to ${bound(high)} ${unitName}` : "";
      if (element.title !== title) element.title = title;
      const part = Math.min(1, Math.max(0, (value - low) / (high - low)));
      element.style.setProperty("--at", Number.isNaN(part) ? "50%" : `${100 * part}%`);
      element.classList.toggle("near", part < 0.05 || part > 0.95);
    }
    for (const element of document.querySelectorAll("[data-when]")) {
      const fits = connected && element.dataset.when.split(" ").includes(state.state);
      if (element.disabled === fits) { element.disabled = !fits; element.ariaDisabled = String(!fits); }
    }
    for (const [path, isThere] of [["/cell", state.partners], ["/processes", state.processes]]) {
      const link = document.querySelector(`#menu [data-path="${path}"]`);
      if (link && link.hidden === Boolean(isThere)) { link.hidden = !isThere; tab(); }
    }
    showFrame();
    const note = document.getElementById("operator");
    if (note) put(note, note.title = state.mine ? "You operate the arm" : state.operator ? `${state.operator} operates the arm` : "Nobody operates the arm");
    const lost = document.getElementById("lost"), old = document.getElementById("old");
    if (lost) lost.hidden = connected;
    const isOld = connected && state.age_s > OLD_S;
    document.body.classList.toggle("old", isOld);
    if (old) {
      old.hidden = !isOld;
      if (isOld) put(old, `Joint values are ${state.age_s.toFixed(1)} s old: since then not every slave has answered.`);
    }
  }
  function showFrame() {
    document.body.dataset.machine = connected ? state.state : "";
    const alarmed = document.getElementById("alarmed");
    if (alarmed) {
      alarmed.hidden = !(connected && state.alarms);
      put(alarmed, `${state.alarms} ${state.alarms === 1 ? "alarm" : "alarms"}`);
    }
    const joystick = document.getElementById("joystick");
    if (joystick) joystick.hidden = !(connected && state.joystick);
    const override = document.querySelector("[data-override]");
    if (override) {
      override.disabled = !connected || state.speed_override === undefined;
      if (document.activeElement !== override || performance.now() - overridden > 1000) override.value = state.speed_override ?? 100;
    }
    lead();
  }
  let overridden = 0; // when somebody moved the slider of the override
  document.addEventListener("input", (event) => { if (event.target.dataset?.override === "") overridden = performance.now(); });

  // The first steps while no platform runs: start, enable, move.
  const LED = "rtcp-led";
  let done = null;
  function lead() {
    const box = document.getElementById("lead");
    if (!box || !connected || (box.hidden && kept(() => localStorage.getItem(LED)))) return;
    if (state.state === "off") done = new Set();
    if (!done) return;
    if (!["off", "starting"].includes(state.state)) done.add("start");
    if (["holding", "moving"].includes(state.state)) done.add("enable");
    if (state.state === "moving") done.add("move");
    const steps = [...box.querySelectorAll("[data-step]")], next = steps.find((step) => !done.has(step.dataset.step));
    for (const step of steps) {
      step.dataset.done = done.has(step.dataset.step);
      step.toggleAttribute("aria-current", step === next);
    }
    box.hidden = false;
    if (!next) setTimeout(endLead, 4000);
  }
  function endLead() {
    kept(() => localStorage.setItem(LED, "1"));
    done = null;
    document.getElementById("lead").hidden = true;
  }
  document.addEventListener("click", (event) => { if (event.target.closest?.("[data-lead-end]")) endLead(); });

  let path = "/";
  function tab(opened = path) { // mark a tab and bring it into view
    document.body.dataset.tab = path = opened;
    for (const link of document.querySelectorAll("#menu a")) {
      const isOpen = link.dataset.path === path;
      link.toggleAttribute("aria-current", false);
      if (isOpen) {
        link.setAttribute("aria-current", "page");
        const menu = link.parentElement;
        menu.scrollTo({ left: link.offsetLeft - (menu.clientWidth - link.clientWidth) / 2 });
      }
    }
  }
  function more() { // whether tabs are beyond the right edge
    const menu = document.getElementById("menu");
    menu?.toggleAttribute("data-more", menu.scrollLeft + menu.clientWidth < menu.scrollWidth - 4);
  }
  setInterval(more, 250);
  setInterval(() => { if (performance.now() - heard > STALE_MS) { release(); show(); } }, 250);

  // -- the operator's hand -----------------------------------------------------------------------------------------------

  const pressed = new Map(); // key or button -> its axis and sign
  let press = 0, pad = null, padEnded = false;
  const AXES = ["x", "y", "z", "rx", "ry", "rz"];
  function stepping() { return document.querySelector("[data-jog-frame]")?.dataset.jogStep ?? ""; }
  function begin(holder, axis, sign) {
    if (stepping()) return;
    if (!pressed.size && !pad) press += 1;
    pressed.set(holder, [axis, sign]);
    send(jogMessage());
  }
  function end(holder) {
    if (!pressed.delete(holder)) return;
    send(jogMessage());
    mark();
  }
  function release() {
    padEnded = true;
    if (!pressed.size && !pad) return;
    pressed.clear();
    pad = null;
    send(jogMessage());
    press += 1;
    mark();
  }
  function jogMessage() {
    const root = document.querySelector("[data-jog-frame]");
    const parts = root ? root.dataset : {};
    const frame = parts.jogFrame ?? "base";
    const count = frame === "joints" ? (state.joints?.actual_position.length ?? 6) : 6;
    const jog = Array(count).fill(0);
    for (const key of pressed.keys()) if (key.isConnected === false || key.disabled) pressed.delete(key);
    for (const [axis, sign] of pressed.values()) if (axis < count) jog[axis] += sign;
    if (pad) pad.forEach((value, axis) => { if (axis < count) jog[axis] += value; });
    const speeds = frame === "joints" ? Array(count).fill(+parts.jogJoint || 0)
      : [0, 1, 2].map(() => +parts.jogSpeed || 0).concat([0, 1, 2].map(() => +parts.jogTurn || 0));
    mark();
    return { jog: jog.map((part, axis) => Math.max(-1, Math.min(1, part)) * speeds[axis]), frame, press };
  }
  function mark() {
    for (const button of document.querySelectorAll("[data-jog]")) {
      button.classList.toggle("pressed", [...pressed.keys()].includes(button));
    }
  }
  function padOf(element) { return element.closest?.("[data-jog]"); }
  function jogOf(element) {
    const button = padOf(element);
    if (!button || button.disabled) return null;
    const [axis, sign] = [button.dataset.jog.slice(0, -1), button.dataset.jog.endsWith("+") ? 1 : -1];
    const at = AXES.indexOf(axis);
    return [button, at >= 0 ? at : +axis, sign];
  }
  document.addEventListener("pointerdown", (event) => {
    const jog = jogOf(event.target);
    if (!jog || event.button > 0 || stepping()) return;
    event.preventDefault();
    jog[0].focus();
    jog[0].setPointerCapture?.(event.pointerId);
    begin(...jog);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    document.addEventListener(name, (event) => end(padOf(event.target)));
  }
  document.addEventListener("contextmenu", (event) => { if (jogOf(event.target)) event.preventDefault(); });

  // By the position of a key: its letter changes with Shift and Caps Lock between press and release.
  const KEYS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [1, 1], ArrowRight: [1, -1], PageUp: [2, 1],
    PageDown: [2, -1], KeyQ: [5, 1], KeyE: [5, -1], KeyA: [3, 1], KeyD: [3, -1], KeyW: [4, 1], KeyS: [4, -1] };
  const GRIPPER = { KeyO: "open", KeyC: "close" };
  // It ends the jog, as every other command does: release, then press again.
  function gripper(which) {
    release();
    document.querySelector(`[data-gripper="${which}"]`)?.click();
  }
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") { stop(); return; }
    const button = jogOf(event.target);
    if (button && !stepping() && (event.key === " " || event.key === "Enter")) {
      event.preventDefault();
      if (!event.repeat) begin(...button);
      return;
    }
    if (event.target.matches?.("input, select, textarea")) return;
    const area = event.target.closest?.("[data-jog-frame]");
    if (!area || event.ctrlKey || event.altKey || event.metaKey) return;
    if (GRIPPER[event.code] && !event.repeat) gripper(GRIPPER[event.code]);
    const movement = KEYS[event.code];
    if (!movement) return;
    event.preventDefault();
    if (event.repeat) return;
    if (stepping()) step(...movement);
    else begin(event.code, ...movement);
  });
  function step(axis, sign) {
    const names = [AXES[axis], axis].map((name) => `[data-jog="${name}${sign > 0 ? "+" : "-"}"]`);
    [...document.querySelectorAll(names.join())].find((button) => button.checkVisibility())?.click();
  }
  document.addEventListener("keyup", (event) => {
    if (event.key === " " || event.key === "Enter") end(padOf(event.target));
    end(event.code);
  });
  for (const name of ["blur", "pagehide"]) window.addEventListener(name, release);
  document.addEventListener("freeze", release);
  document.addEventListener("visibilitychange", () => { if (document.hidden) release(); });
  document.addEventListener("focusout", (event) => end(padOf(event.target)));

  // A gamepad jogs while its left shoulder button is held: left stick X-Y, right stick Z and yaw, cross roll and pitch;
  // A closes and B opens the gripper.
  let lastGripper = "";
  function gamepad() {
    const area = document.querySelector("[data-jog-frame]");
    const device = area && !document.hidden && document.hasFocus() && [...navigator.getGamepads()].find((gamepad) => gamepad?.connected);
    const enabled = device && !stepping() && device.buttons[4]?.pressed;
    const wanted = !device ? "" : device.buttons[0]?.pressed ? "close" : device.buttons[1]?.pressed ? "open" : "";
    const begins = wanted && wanted !== lastGripper;
    lastGripper = wanted;
    if (enabled && begins) { gripper(wanted); return; }
    if (!enabled) padEnded = false;
    if (!enabled || padEnded) { if (pad) { pad = null; if (!pressed.size) { send(jogMessage()); press += 1; } } return; }
    if (!pad && !pressed.size) press += 1;
    const stick = (at) => (Math.abs(device.axes[at] ?? 0) > 0.15 ? device.axes[at] : 0);
    const cross = (plus, minus) => (device.buttons[plus]?.pressed ? 1 : 0) - (device.buttons[minus]?.pressed ? 1 : 0);
    pad = [-stick(1), -stick(0), -stick(3), cross(15, 14), cross(12, 13), -stick(2)];
  }

  function stop() {
    release();
    if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ seen: token, visible: true, stop: true }));
    // Over HTTP as well: the socket may hang.
    fetch("/stop", { method: "POST", keepalive: true })
      .then(async (answer) => { if (!answer.ok) say(`STOP was not carried out: ${await answer.text()}`); })
      .catch(() => say("STOP did not reach the panel: use the emergency stop"));
  }
  document.addEventListener("click", (event) => { if (event.target.closest?.("[data-stop]")) stop(); });

  // -- fields ------------------------------------------------------------------------------------------------------------

  function sliderOf(field) { return document.querySelector(`[data-slider="${field.id}"]`); }
  function fill(id, value) {
    const field = document.getElementById(id);
    if (!field) return;
    write(field, value);
    const slider = sliderOf(field);
    if (slider) slider.value = value;
  }
  document.addEventListener("input", (event) => {
    const field = document.getElementById(event.target.dataset?.slider);
    if (field) {
      write(field, event.target.value);
      field.dispatchEvent(new Event("input"));
    } else if (event.target.id) {
      const slider = sliderOf(event.target);
      if (slider) slider.value = typed(event.target);
    }
  });

  window.addEventListener("load", () => {
    const wait = setInterval(() => {
      // Before the handshake of NiceGUI's socket a click or a choice on the page would be lost.
      if (!pageKey() || !window.did_handshake) return;
      clearInterval(wait);
      connect();
      const head = document.getElementById("head"); // notifications lie below it
      new ResizeObserver(() => document.body.style.setProperty("--head", `${head.offsetHeight}px`)).observe(head);
    }, 50);
  });
  function showArm() { document.getElementById("space").scrollIntoView({ block: "nearest" }); }
  return { fill, stop, tab, showArm, typed, unit, get stepping() { return stepping(); }, get token() { return token; }, get state() { return state; },
    listen: (listener) => { listeners.add(listener); return () => listeners.delete(listener); },
    scope: (picture) => { pictures.add(picture); return () => pictures.delete(picture); } };
})();
