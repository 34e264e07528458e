"use strict";
/* The surroundings from above, nose up, metres around the vehicle: obstacles per sector, trail, wish and velocity. */
const TopView = (() => {
  const trail = [];

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  }

  function jet(share) {
    const ramp = x => Math.round(255 * Math.max(0, Math.min(1, 1.5 - Math.abs(4 * share - x))));
    return `rgb(${ramp(3)},${ramp(2)},${ramp(1)})`;
  }

  function remember(vehicle, baselineMm) {
    const last = trail[trail.length - 1];
    if (!last || Math.hypot(last.n - vehicle.north_m, last.e - vehicle.east_m) > 0.15)
      trail.push({ n: vehicle.north_m, e: vehicle.east_m, b: baselineMm });
    if (trail.length > 400) trail.shift();
  }

  function draw(canvas, shown) {
    const { vehicle, depth, command, baseline, speed } = shown;
    const scale = devicePixelRatio || 1, w = canvas.clientWidth * scale, h = canvas.clientHeight * scale;
    if (canvas.width !== Math.round(w) || canvas.height !== Math.round(h)) { canvas.width = w; canvas.height = h; }
    const g = canvas.getContext("2d");
    g.clearRect(0, 0, w, h);
    const range = rangeFor(command, speed), px = 0.8 * h / range;
    const x = right => w / 2 + right * px, y = forward => 0.86 * h - forward * px;
    if (depth) view(g, x, y, depth, range, speed);
    rings(g, x, y, px, range, scale);
    if (depth) obstacles(g, x, y, depth, range, scale);
    if (vehicle) {
      remember(vehicle, baseline ? baseline.baseline_mm : 200);
      drawTrail(g, x, y, vehicle, scale);
      if (command) arrow(g, x, y, turned(vehicle, command.v_north_m_s, command.v_east_m_s), colour("--green"), 2 * scale);
      arrow(g, x, y, turned(vehicle, vehicle.v_north_m_s, vehicle.v_east_m_s), colour("--ink"), 3 * scale);
    }
    craft(g, x, y, baseline, scale);
    return range;
  }

  function rangeFor(command, speed) {
    const reach = Math.max((command && command.clear_m) || 0, (speed && speed.trust_m) || 0, 4);
    return [5, 10, 20, 40].find(r => reach <= r) || 40;
  }

  function turned(vehicle, north, east) {
    const c = Math.cos(vehicle.yaw_rad), s = Math.sin(vehicle.yaw_rad);
    return { forward: c * north + s * east, right: -s * north + c * east };
  }

  function rings(g, x, y, px, range, scale) {
    g.strokeStyle = colour("--line"); g.fillStyle = colour("--dim");
    g.lineWidth = scale; g.font = `${11 * scale}px system-ui`;
    const step = range / 5;
    for (let r = step; r <= range * 1.3; r += step) {
      g.beginPath(); g.arc(x(0), y(0), r * px, Math.PI, 2 * Math.PI); g.stroke();
      if (r <= range) g.fillText(`${r} m`, x(0) + 4 * scale, y(r) - 3 * scale);
    }
  }

  function edge(x, y, depth, k, r) {
    const a = (k / depth.sectors_m.length - 0.5) * depth.h_fov_rad;
    return [x(r * Math.sin(a)), y(r * Math.cos(a))];
  }

  function view(g, x, y, depth, range, speed) {
    const seen = Math.min((speed && speed.trust_m) || range, range * 1.2);
    g.fillStyle = colour("--fill");
    g.beginPath(); g.moveTo(x(0), y(0));
    for (let k = 0; k <= depth.sectors_m.length; k++) g.lineTo(...edge(x, y, depth, k, seen));
    g.closePath(); g.fill();
  }

  function obstacles(g, x, y, depth, range, scale) {
    g.strokeStyle = colour("--red"); g.lineWidth = 4 * scale; g.lineCap = "round";
    depth.sectors_m.forEach((r, k) => {
      if (r === null || r > range * 1.3) return;
      g.beginPath(); g.moveTo(...edge(x, y, depth, k, r)); g.lineTo(...edge(x, y, depth, k + 1, r)); g.stroke();
    });
  }

  function drawTrail(g, x, y, vehicle, scale) {
    g.lineWidth = 3 * scale;
    for (let i = 1; i < trail.length; i++) {
      const a = turned(vehicle, trail[i - 1].n - vehicle.north_m, trail[i - 1].e - vehicle.east_m);
      const b = turned(vehicle, trail[i].n - vehicle.north_m, trail[i].e - vehicle.east_m);
      g.strokeStyle = jet((trail[i].b - 100) / 200);
      g.beginPath(); g.moveTo(x(a.right), y(a.forward)); g.lineTo(x(b.right), y(b.forward)); g.stroke();
    }
  }

  function arrow(g, x, y, v, stroke, width) {
    if (Math.hypot(v.forward, v.right) < 0.05) return;
    const tip = [x(v.right), y(v.forward)], from = [x(0), y(0)];
    const a = Math.atan2(tip[1] - from[1], tip[0] - from[0]), head = 4 * width;
    g.strokeStyle = stroke; g.lineWidth = width;
    g.beginPath(); g.moveTo(...from); g.lineTo(...tip);
    for (const side of [-2.6, 2.6]) { g.moveTo(...tip); g.lineTo(tip[0] + head * Math.cos(a + side), tip[1] + head * Math.sin(a + side)); }
    g.stroke();
  }

  function craft(g, x, y, baseline, scale) {
    const half = (baseline ? baseline.baseline_mm : 200) / 200 * 11 * scale, side = 9 * scale;
    g.fillStyle = colour("--ground"); g.strokeStyle = colour("--ink"); g.lineWidth = 2 * scale;
    g.beginPath(); g.rect(x(0) - side, y(0) - side, 2 * side, 2 * side); g.fill(); g.stroke();
    g.strokeStyle = jet(((baseline ? baseline.baseline_mm : 200) - 100) / 200); g.lineWidth = 6 * scale; g.lineCap = "round";
    g.beginPath(); g.moveTo(x(0) - half, y(0) - side); g.lineTo(x(0) + half, y(0) - side); g.stroke();
  }

  return { draw };
})();
