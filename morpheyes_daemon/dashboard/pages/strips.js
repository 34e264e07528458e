"use strict";
/* The live strips: the last minute of depth, baseline and speed, drawn by uPlot over one shared cursor. */
const Strips = (() => {
  const KEPT = 300;
  const PANELS = [
    { title: "depth [m]", series: [["nearest", "z_close_m", "--blue", 2], ["trusted to", "trust_m", "--dim", 1], ["too near below", "near_m", "--orange", 1]] },
    { title: "baseline [mm]", series: [["modelled", "baseline_mm", "--orange", 2], ["target", "target_mm", "--dim", 1]], range: [80, 320] },
    { title: "speed [m/s]", series: [["flown", "speed_m_s", "--ink", 2], ["limit", "limit_m_s", "--red", 1.5], ["wanted", "wanted_m_s", "--dim", 1]] },
  ];
  let columns = [], rows = [], plots = [];

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  }

  function column(name) {
    const i = columns.indexOf(name);
    return rows.map(row => row[i]);
  }

  function data(panel) {
    return [column("t_s"), ...panel.series.map(([, name]) => column(name))];
  }

  function build(room) {
    plots.forEach(p => p.plot.destroy());
    const cursor = { sync: { key: "flight" }, drag: { x: false, y: false } };
    plots = PANELS.map(panel => {
      const axis = { stroke: colour("--dim"), grid: { stroke: colour("--line"), width: 1 }, ticks: { show: false }, size: 38 };
      const series = panel.series.map(([label, , name, width]) => ({ label, stroke: colour(name), width, points: { show: false } }));
      const y = { range: (_, low, high) => panel.range || [0, Math.max(1, Math.min(30, (high || 0) * 1.1))] };
      const plot = new uPlot({
        title: panel.title, width: width(room), height: 170, cursor, legend: { live: false }, series: [{}, ...series],
        scales: { x: { time: false }, y }, axes: [{ ...axis, size: 26 }, axis],
      }, data(panel), room);
      return { panel, plot };
    });
  }

  function width(room) {
    const inner = room.clientWidth - 24, across = Math.max(1, Math.min(3, Math.floor(inner / 300)));
    return Math.floor(inner / across) - 12;
  }

  function reset(room, names, history) {
    columns = names; rows = history; build(room);
  }

  function add(row) {
    rows.push(row);
    if (rows.length > KEPT) rows.shift();
    plots.forEach(({ panel, plot }) => plot.setData(data(panel)));
  }

  function resize(room) {
    plots.forEach(({ plot }) => plot.setSize({ width: width(room), height: 170 }));
  }

  return { reset, add, resize, restyle: build };
})();
