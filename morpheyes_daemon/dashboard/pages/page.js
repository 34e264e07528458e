"use strict";
/* The socket, and everything on the page that is text. The page listens; the one thing it may ask is a stop. */
(() => {
  const MODES = { 0: "Stabilize", 1: "Acro", 2: "AltHold", 3: "Auto", 4: "Guided", 5: "Loiter", 6: "RTL", 7: "Circle", 9: "Land",
    11: "Drift", 13: "Sport", 15: "Autotune", 16: "PosHold", 17: "Brake", 18: "Throw", 20: "GuidedNoGPS", 21: "SmartRTL", 22: "FlowHold" };
  const STALE_MS = 1500, OLD_S = 1.0;
  const $ = id => document.getElementById(id);
  const text = (id, value) => { if ($(id).textContent !== value) $(id).textContent = value; };
  const fixed = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));
  let lastSnapshot = 0;

  $("stop").addEventListener("click", async () => {
    const answer = await fetch("/api/stop", { method: "POST", headers: { "X-MorphEyes": "stop" } }).catch(() => null);
    text("stop", answer && answer.ok ? "STOP asked" : "STOP: no answer");
    setTimeout(() => text("stop", "STOP"), 2000);
  });

  function hello(content) {
    Strips.reset($("strips"), content.columns, content.rows);
    text("identity", Object.entries(content.identity).map(([key, value]) => `${key} ${value}`).join(" · "));
    $("events").replaceChildren();
  }

  function show(shown) {
    const { vehicle, command, baseline, speed, depth } = shown;
    const missing = shown.missing && shown.state === "preflight" ? shown.missing : null;
    $("banner").dataset.state = shown.state || "none";
    text("state", shown.state || "starting");
    text("action", shown.action ? `sends ${shown.action}` : "");
    text("reason", (missing || shown.reason || { text: "" }).text);
    text("speed", fixed(vehicle && vehicle.speed_m_s, 1));
    text("limit", speed ? `of ${fixed(speed.limit_m_s, 1)} (${speed.bound})` : "");
    text("zclose", fixed(command && command.z_close_m, 1));
    text("baseline", fixed(baseline && baseline.baseline_mm, 0));
    text("height", fixed(vehicle && vehicle.height_m, 1));
    text("battery", fixed(vehicle && vehicle.battery_v, 1));
    text("charge", vehicle && vehicle.battery_fraction !== null ? `${Math.round(100 * vehicle.battery_fraction)} %` : "");
    text("mode", vehicle ? MODES[vehicle.mode] || `mode ${vehicle.mode}` : "–");
    text("armed", vehicle ? (vehicle.armed ? "armed" : "disarmed") : "\u00a0");
    text("depth-note", depth ? `${fixed(depth.valid_pct, 0)} % known` : "");
    text("calibration", depth ? `, from ${fixed(depth.near_m, 2)} m, calibration ${depth.calibration_hash.slice(0, 8)}` : "");
    text("left-age", shown.health && shown.health.ages_s.frame !== null ? `${fixed(shown.health.ages_s.frame, 2)} s old` : "");
    text("range", `${TopView.draw($("topview"), shown)} m`);
    if (shown.health) health(shown.health);
  }

  function health(report) {
    const body = $("health").tBodies[0], names = Object.keys(report.ages_s);
    while (body.rows.length < names.length) { const row = body.insertRow(); row.insertCell(); row.insertCell(); row.insertCell(); }
    names.forEach((name, i) => {
      const row = body.rows[i], age = report.ages_s[name];
      row.className = age !== null && age > OLD_S ? "old" : "";
      row.cells[0].textContent = name;
      row.cells[1].textContent = age === null ? "never" : `${age.toFixed(2)} s`;
      row.cells[2].textContent = `${fixed(report.rates_hz[name], 1)} Hz`;
    });
    const again = Object.entries(report.restarts).filter(([, n]) => n > 0).map(([name, n]) => `${name} ${n}×`).join(", ");
    text("loop", `loop ${fixed(report.lateness_ms, 1)} ms late, worst ${fixed(report.worst_lateness_ms, 1)} ms; restarts: ${again || "none"}`);
  }

  function events(rows) {
    for (const event of rows) {
      const line = document.createElement("li"), cells = [["time", fixed(event.t_s, 1), ""], ["span", event.source, "source"],
        ["span", event.detail ? `${event.text}: ${event.detail}` : event.text, event.fault ? "fault" : ""]];
      for (const [tag, content, kind] of cells) {
        const cell = document.createElement(tag);
        cell.textContent = content; cell.className = kind;
        line.append(cell);
      }
      $("events").prepend(line);
    }
    while ($("events").children.length > 200) $("events").lastChild.remove();
  }

  function image(id, data) {
    const url = URL.createObjectURL(new Blob([data], { type: "image/jpeg" })), old = $(id).src;
    $(id).src = url;
    if (old) URL.revokeObjectURL(old);
  }

  function receive(message) {
    if (message.data instanceof ArrayBuffer) {
      image(new Uint8Array(message.data)[0] === 0x4c ? "left" : "depth", message.data.slice(1));
      return;
    }
    const content = JSON.parse(message.data);
    if (content.hello) hello(content.hello);
    if (content.events) events(content.events);
    if (content.snapshot) {
      lastSnapshot = performance.now();
      Strips.add(content.row);
      show(content.snapshot);
    }
  }

  function connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = receive;
    socket.onclose = () => setTimeout(connect, 1000);
  }

  function watch() {
    const stale = performance.now() - lastSnapshot > STALE_MS;
    document.body.classList.toggle("stale", stale);
    if (stale) { $("banner").dataset.state = "none"; text("state", "no connection"); text("reason", "what is shown is old"); text("action", ""); }
  }

  function theme(name) {
    document.documentElement.dataset.theme = name;
    Strips.restyle($("strips"));
  }

  document.documentElement.dataset.theme = localStorage.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  $("theme").onclick = () => { localStorage.theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark"; theme(localStorage.theme); };
  addEventListener("resize", () => Strips.resize($("strips")));
  setInterval(watch, 500);
  connect();
})();
