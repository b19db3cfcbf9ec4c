(() => {
  const box = document.currentScript.parentElement, canvas = box.querySelector('canvas'), g = canvas.getContext('2d');
  const slider = box.querySelector('input'), button = box.querySelector('button'), label = box.querySelector('output');
  const flights = JSON.parse(box.querySelector('script[type="application/json"]').textContent).flights;
  const every = flights.flatMap(f => [...f.p, ...f.pad]);
  const low = [0, 1, 2].map(k => Math.min(...every.map(p => p[k]))), high = [0, 1, 2].map(k => Math.max(...every.map(p => p[k])));
  const begin = Math.min(...flights.map(f => f.t[0])), end = Math.max(...flights.map(f => f.t[f.t.length - 1]));
  const a = low.map(v => Math.floor(v - 0.5)), b = high.map(v => Math.ceil(v + 0.5)), origin = [a[0], a[1], 0];  // of floor and axes
  const ends = [0, 1, 2].map(n => origin.map((v, k) => v + (k === n)));
  const centre = low.map((v, k) => (v + high[k]) / 2);
  let scale = 1;
  let az = -1.2, el = 0.3, now = end, playing = false, right, up, towards;
  const axes = () => {
    const [ca, sa, ce, se] = [Math.cos(az), Math.sin(az), Math.cos(el), Math.sin(el)];
    right = [-sa, ca, 0]; up = [-ca * se, -sa * se, ce]; towards = [ca * ce, sa * ce, se];
  };
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const project = p => {
    const d = p.map((v, k) => v - centre[k]);
    return [canvas.width / 2 + scale * dot(d, right), canvas.height / 2 - scale * dot(d, up), dot(d, towards)];
  };
  const fit = () => {  // flights, pads and axes fill 0.85 of the canvas: room for a rotor and the names of the axes
    axes();
    const shown = [...every, origin, ...ends].map(project);
    const [left, top] = [0, 1].map(k => Math.min(...shown.map(p => p[k])));
    const [wide, tall] = [Math.max(...shown.map(p => p[0])) - left, Math.max(...shown.map(p => p[1])) - top];
    const [dx, dy] = [left + wide / 2 - canvas.width / 2, top + tall / 2 - canvas.height / 2];
    for (let k = 0; k < 3; k++) centre[k] += dx * right[k] - dy * up[k];
    scale = 0.85 * Math.min(canvas.width / wide, canvas.height / tall);
  };
  const turn = ([x, y, z, w], v) => {  // by a quaternion xyzw
    const t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
    const u = [y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0]];
    return v.map((c, k) => c + w * t[k] + u[k]);
  };
  let things;
  const add = (points, style) => {
    const at = points.map(project);
    things.push({at, style, depth: at.reduce((sum, p) => sum + p[2], 0) / at.length + (style.lift || 0)});
  };
  const line = (points, style) => { for (let k = 1; k < points.length; k++) add([points[k - 1], points[k]], style); };
  const floor = () => {
    const style = {stroke: '#ddd', width: 1, lift: -100};
    for (let x = a[0]; x <= b[0]; x++) add([[x, a[1], 0], [x, b[1], 0]], style);
    for (let y = a[1]; y <= b[1]; y++) add([[a[0], y, 0], [b[0], y, 0]], style);
    [['x', '#c33'], ['y', '#393'], ['z', '#36c']].forEach(([name, stroke], n) =>
      add([origin, ends[n]], {stroke, width: 2, text: name + ', 1 m'}));
  };
  const vehicle = (f, k) => {
    const q = f.q[k], at = v => turn(q, v).map((c, i) => c + f.p[k][i]);
    const distances = f.rotors.flatMap((a, i) => f.rotors.slice(i + 1).map(b => Math.hypot(a[0] - b[0], a[1] - b[1])));
    const gap = Math.min(...distances);
    f.rotors.forEach(([x, y]) => {
      add([f.p[k], at([x, y, 0])], {stroke: '#222', width: 3});
      const r = 0.42 * gap, angles = Array.from({length: 20}, (_, i) => i * Math.PI / 10);
      const ring = angles.map(a => at([x + r * Math.cos(a), y + r * Math.sin(a), 0.02]));
      add(ring, {stroke: x > 0 ? '#d62728' : f.colour, width: 1.5, fill: f.colour + '55'});
    });
    add([f.p[k], at([0, 0, 0.15])], {stroke: '#d62728', width: 2});
  };
  const draw = () => {
    axes(); things = []; floor();
    flights.forEach((f, n) => {
      const same = (name) => flights.slice(0, n).some(g => JSON.stringify(g[name]) === JSON.stringify(f[name]));
      if (f.pad.length && !same('pad')) add(f.pad, {stroke: '#333', width: 1.5, fill: '#0001'});
      f.cables.forEach(c => { if (!same('cables')) add(c, {stroke: '#444', width: 3}); });
      line(f.reference, {stroke: f.colour, width: 0.8, lift: -0.01});
      const k = Math.max(0, f.t.findLastIndex(t => t <= now + 1e-6));
      line(f.p.slice(0, k + 1), {stroke: f.colour, width: 2.2});
      vehicle(f, k);
    });
    g.clearRect(0, 0, canvas.width, canvas.height);
    things.sort((a, b) => a.depth - b.depth).forEach(({at, style}) => {
      g.beginPath(); at.forEach(([x, y], k) => k ? g.lineTo(x, y) : g.moveTo(x, y));
      if (style.fill) { g.closePath(); g.fillStyle = style.fill; g.fill(); }
      g.strokeStyle = style.stroke; g.lineWidth = style.width; g.stroke();
      if (style.text) { g.fillStyle = style.stroke; g.font = '14px sans-serif'; g.fillText(style.text, at[1][0] + 4, at[1][1]); }
    });
    label.textContent = now.toFixed(2) + ' s';
  };
  let from = null;
  canvas.onpointerdown = e => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointerup = () => { from = null; };
  canvas.onpointermove = e => {
    if (!from) return;
    const dx = e.clientX - from[0], dy = e.clientY - from[1], m = canvas.width / canvas.clientWidth / scale;
    from = [e.clientX, e.clientY];
    if (e.shiftKey) for (let k = 0; k < 3; k++) centre[k] += m * (dy * up[k] - dx * right[k]);
    else { az -= 0.008 * dx; el = Math.max(-1.57, Math.min(1.57, el + 0.008 * dy)); }
    draw();
  };
  canvas.addEventListener('wheel', e => { e.preventDefault(); scale *= Math.exp(-0.001 * e.deltaY); draw(); }, {passive: false});
  slider.oninput = () => { now = begin + (end - begin) * slider.value / 1000; draw(); };
  let last = 0;
  const step = t => {
    if (!playing) return;
    now = Math.min(end, now + (t - last) / 1000); last = t;
    slider.value = 1000 * (now - begin) / (end - begin); draw();
    if (now >= end) stop(); else requestAnimationFrame(step);
  };
  const stop = () => { playing = false; button.textContent = 'play'; };
  button.onclick = () => {
    if (playing) return stop();
    if (now >= end) now = begin;
    playing = true; button.textContent = 'pause';
    requestAnimationFrame(t => { last = t; step(t); });
  };
  fit(); draw();
})();
