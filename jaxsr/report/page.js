"use strict";
// The viewer of report.html. It holds no numbers of its own: all come from the JSON in #data. State lives in
// one object and in the address (#section=0&frame=3&left=truth&right=taau&view=error), so a view can be linked.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const $ = (id) => document.getElementById(id);
  const escape = (s) => String(s).replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);
  const n = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
  const stage = $("stage"), canvas = $("canvas"), handle = $("handle"), tip = $("tip");

  const VIEWS = [["image", "Image", "The frames as they are"], ["error", "Error", "|difference| to the truth, mean of R, G, B"],
    ["flip", "FLIP", "FLIP error map against the truth"], ["diff", "Left − right", "|difference| between left and right, mean of R, G, B"]];
  const SCALES = [0.02, 0.05, 0.1, 0.2, 0.5, 1];
  const ZOOMS = [1, 2, 3, 4, 6, 8];
  const FPS = [...new Set([1, 2, 4, 8, 12, 24, 30, 60, data.fps])].sort((a, b) => a - b);
  const state = { section: 0, frame: 0, left: "", right: "", view: "image", scale: 0.2, zoom: 0, x: 0.5, y: 0.5, split: 0.5, subset: "", region: "all", fps: data.fps };
  let playing = 0, pointer = null, queued = false, hover = null;

  // Sources: what can be put on a side. Every section has the truth, perhaps the input, and its tracks.
  const methods = [...new Set(data.sections.flatMap((s) => s.tracks.map((t) => t.name)))];
  for (const s of data.sections) {
    s.sources = [{ key: "truth", name: "Truth", color: "var(--truth)", images: s.truth }];
    if (s.input) s.sources.push({ key: "input", name: "Input", color: "var(--input)", images: s.input, note: s.input_note, flip: null });
    s.tracks.forEach((t) => {
      const i = methods.indexOf(t.name); // a method has one colour on the whole page
      s.sources.push({ ...t, color: `var(--t${i % 10})`, dash: i > 9 ? "5 3" : "" });
    });
    s.hasFlip = s.tracks.some((t) => t.flip);
  }
  const section = () => data.sections[state.section];
  // The metrics of a source on the chosen pixels: every value is a list over the frames.
  const metricsOf = (t) => (state.region === "all" ? t.metrics : t.regions?.[state.region]);
  const metricKeys = () => Object.keys(data.metrics).filter((k) => section().tracks.some((t) => metricsOf(t)?.[k]));
  const source = (key) => section().sources.find((s) => s.key === key);
  const frames = () => section().frames.length;
  document.documentElement.classList.add("js");

  // ---- images: decoded when first needed, pixels and maps kept in small caches
  const pictures = new Map(), pixelCache = new Map(), mapCache = new Map();
  const keep = (cache, key, make, limit) => {
    let value = cache.get(key);
    if (value === undefined) value = make(); else cache.delete(key);
    if (value === null) return null;
    cache.set(key, value);
    if (cache.size > limit) cache.delete(cache.keys().next().value);
    return value;
  };
  function picture(index) {
    let entry = pictures.get(index);
    if (!entry) {
      entry = { image: new Image(), ready: false, broken: false };
      pictures.set(index, entry);
      entry.image.onload = () => { entry.ready = true; draw(); };
      entry.image.onerror = () => { entry.broken = true; draw(); };
      entry.image.src = data.images[index];
    }
    return entry;
  }
  function pixels(index) {
    return keep(pixelCache, index, () => {
      const entry = picture(index);
      if (!entry.ready) return null;
      const c = document.createElement("canvas");
      c.width = entry.image.naturalWidth; c.height = entry.image.naturalHeight;
      const context = c.getContext("2d", { willReadFrequently: true });
      context.drawImage(entry.image, 0, 0);
      return context.getImageData(0, 0, c.width, c.height);
    }, 48);
  }
  const LUT = data.colormap.match(/../g).map((h) => parseInt(h, 16));
  function colored(width, height, valueAt, limit) {
    const c = document.createElement("canvas");
    c.width = width; c.height = height;
    const context = c.getContext("2d"), out = context.createImageData(width, height);
    for (let y = 0, o = 0; y < height; y++) for (let x = 0; x < width; x++, o += 4) {
      const k = 3 * Math.min(255, Math.round((255 * valueAt(x, y)) / limit));
      out.data[o] = LUT[k]; out.data[o + 1] = LUT[k + 1]; out.data[o + 2] = LUT[k + 2]; out.data[o + 3] = 255;
    }
    context.putImageData(out, 0, 0);
    return c;
  }
  // Nearest pixel: an input of lower resolution is compared as it is shown.
  const at = (p, x, y, w, h) => 4 * (Math.floor(((y + 0.5) * p.height) / h) * p.width + Math.floor(((x + 0.5) * p.width) / w));
  function difference(a, b) {
    const [w, h] = section().size, p = pixels(a), q = pixels(b);
    if (!p || !q) return null;
    return keep(mapCache, `d${a},${b},${state.scale}`, () => colored(w, h, (x, y) => {
      const i = at(p, x, y, w, h), j = at(q, x, y, w, h);
      return (Math.abs(p.data[i] - q.data[j]) + Math.abs(p.data[i + 1] - q.data[j + 1]) + Math.abs(p.data[i + 2] - q.data[j + 2])) / 765;
    }, state.scale), 48);
  }
  function flipMap(index) {
    const [w, h] = section().size, p = pixels(index);
    return p && keep(mapCache, `f${index},${state.scale}`, () => colored(w, h, (x, y) => p.data[at(p, x, y, w, h)] / 255, state.scale), 48);
  }
  // What to draw for a source in the current view: {image} or {text}.
  function shown(src) {
    const f = state.frame, index = src.images[f], truth = section().truth[f];
    if (!section().embedded[f]) return { text: "this frame's images are not in the page" };
    if (index == null && state.view !== "diff") return { text: "not rendered: this frame is extrapolated" };
    const wait = (x) => (x ? { image: x } : { text: "" });
    if (state.view === "error") return wait(difference(index, truth));
    if (state.view === "diff") {
      const l = source(state.left).images[f], r = source(state.right).images[f];
      return l == null || r == null ? { text: "one side is not rendered" } : wait(difference(l, r));
    }
    if (state.view === "flip") {
      if (src.key === "truth") return wait(difference(truth, truth));
      return src.flip && src.flip[f] != null ? wait(flipMap(src.flip[f])) : { text: "no FLIP map" };
    }
    const entry = picture(index);
    return entry.broken ? { text: "this browser cannot decode the image" } : wait(entry.ready && entry.image);
  }

  // ---- geometry: zoom in CSS pixels per image pixel; (x, y) is the image point at the stage's centre, 0..1
  function fitZoom() {
    const [w, h] = section().size, room = Math.min(stage.clientWidth / w, Math.max(260, innerHeight * 0.66) / h);
    return room >= 1 ? Math.floor(room) : room;
  }
  const zoom = () => (state.zoom > 0 ? state.zoom : fitZoom());
  function origin() {
    const [w, h] = section().size, z = zoom(), place = (size, room, c) => (size * z <= room ? (room - size * z) / 2 : clamp(room / 2 - c * size * z, room - size * z, 0));
    return [place(w, stage.clientWidth, state.x), place(h, stage.clientHeight, state.y)];
  }
  function setZoom(z, px = stage.clientWidth / 2, py = stage.clientHeight / 2) {
    const [w, h] = section().size, [ox, oy] = origin(), old = zoom();
    const ix = (px - ox) / old, iy = (py - oy) / old;
    state.zoom = z;
    const now = zoom();
    state.x = clamp((ix + (stage.clientWidth / 2 - px) / now) / w, 0, 1);
    state.y = clamp((iy + (stage.clientHeight / 2 - py) / now) / h, 0, 1);
    update();
  }
  function stepZoom(direction, px, py) {
    const z = zoom(), levels = fitZoom() < 1 ? [fitZoom(), ...ZOOMS] : ZOOMS;
    const next = direction > 0 ? levels.find((l) => l > z + 1e-6) : levels.filter((l) => l < z - 1e-6).pop();
    if (next) setZoom(next < 1 ? 0 : next, px, py);
  }

  function draw() {
    if (queued) return;
    queued = true;
    requestAnimationFrame(() => { queued = false; paint(); });
  }
  function paint() {
    const [w, h] = section().size, dpr = devicePixelRatio || 1, height = Math.max(200, Math.round(h * fitZoom()));
    if (stage.style.height !== `${height}px`) stage.style.height = `${height}px`;
    const W = stage.clientWidth, H = stage.clientHeight;
    if (canvas.width !== Math.round(W * dpr) || canvas.height !== Math.round(H * dpr)) { canvas.width = Math.round(W * dpr); canvas.height = Math.round(H * dpr); }
    const g = canvas.getContext("2d"), z = zoom(), [ox, oy] = origin(), cut = state.split * W;
    g.setTransform(dpr, 0, 0, dpr, 0, 0);
    g.clearRect(0, 0, W, H);
    g.imageSmoothingEnabled = z < 1;
    g.imageSmoothingQuality = "high";
    let complete = true;
    for (const [key, from, to] of state.view === "diff" ? [[state.right, 0, W]] : [[state.left, 0, cut], [state.right, cut, W]]) {
      const { image, text } = shown(source(key));
      g.save();
      g.beginPath(); g.rect(from, 0, to - from, H); g.clip();
      if (image) g.drawImage(image, ox, oy, w * z, h * z);
      else if (text) {
        g.fillStyle = "#80808030"; g.fillRect(ox, oy, w * z, h * z);
        g.fillStyle = getComputedStyle(document.body).color; g.font = "14px system-ui, sans-serif"; g.textAlign = "center";
        const a = Math.max(from, ox), b = Math.min(to, ox + w * z);
        g.fillText(text, (a + b) / 2, H / 2, Math.max(0, b - a - 12));
      } else complete = false;
      g.restore();
    }
    handle.style.left = `${cut}px`;
    handle.style.visibility = state.view === "diff" ? "hidden" : "visible";
    stage.classList.toggle("grab", w * z > W || h * z > H);
    probe();
    if (complete) document.documentElement.dataset.drawn = `${state.section}/${section().frames[state.frame]}/${state.left}/${state.right}/${state.view}`;
  }

  // ---- text around the stage
  const show = (v, key) => (v == null ? "–" : v === "inf" ? "∞" : v.toFixed(data.metrics[key].digits));
  function chip(element, src) {
    const m = metricsOf(src) || {};
    const values = ["psnr", "flip"].filter((k) => m[k]).map((k) => `${data.metrics[k].label} ${show(m[k][state.frame], k)}`).join(" · ");
    element.innerHTML = `<span>${escape(src.name)}</span>${values ? `<small>${values}</small>` : ""}`;
  }
  function probe() {
    const box = $("probe");
    const [w, h] = section().size, [ox, oy] = origin(), z = zoom();
    const x = pointer ? Math.floor((pointer[0] - ox) / z) : -1, y = pointer ? Math.floor((pointer[1] - oy) / z) : -1;
    if (x < 0 || y < 0 || x >= w || y >= h) { box.textContent = "Point at the image to read pixel values (sRGB, 0 to 255)."; return; }
    const parts = [`x <b>${String(x).padStart(4)}</b>  y <b>${String(y).padStart(4)}</b>`];
    const seen = new Set();
    for (const key of [state.left, state.right, "truth"]) {
      if (seen.has(key)) continue;
      seen.add(key);
      const src = source(key), index = src.images[state.frame], p = index == null ? null : pixels(index);
      if (!p) continue;
      const i = at(p, x, y, w, h);
      parts.push(`${escape(src.name)} <b>${[0, 1, 2].map((c) => String(p.data[i + c]).padStart(3)).join(" ")}</b>`);
    }
    box.innerHTML = parts.join("   ");
  }
  function buttons(element, items, current, choose, role = "radio") {
    element.innerHTML = items.map(([value, label, title]) => `<button type="button" role="${role}" data-value="${escape(value)}" title="${escape(title || label)}">${escape(label)}</button>`).join("");
    element.onclick = (e) => { const b = e.target.closest("button"); if (b) choose(b.dataset.value); };
    if (role === "radio") element.onkeydown = (e) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[e.key];
      if (!step) return;
      e.preventDefault(); e.stopPropagation();
      const all = [...element.querySelectorAll("button")], i = all.indexOf(document.activeElement);
      const next = all[(i + step + all.length) % all.length];
      choose(next.dataset.value); element.querySelector(`[data-value="${CSS.escape(next.dataset.value)}"]`)?.focus();
    };
    mark(element, current);
  }
  function mark(element, current) {
    for (const b of element.querySelectorAll("button")) {
      const on = b.dataset.value === String(current);
      b.setAttribute(b.getAttribute("role") === "radio" ? "aria-checked" : "aria-pressed", on);
      if (b.getAttribute("role") === "radio") b.tabIndex = on ? 0 : -1;
    }
  }

  // ---- charts
  function ticks(low, high) {
    const raw = (high - low) / 4 || 1, power = 10 ** Math.floor(Math.log10(raw)), step = power * [1, 2, 5, 10].find((m) => m * power >= raw);
    const out = [];
    for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) out.push(v);
    return [out, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
  }
  const CHART = { left: 44, right: 8, top: 8, bottom: 17, height: 130 };
  // As many charts in a row as there are metrics, if each gets 250 pixels.
  function chartWidth() {
    const room = $("charts").clientWidth || 350, count = metricKeys().length || 1;
    const fit = clamp(Math.floor((room + 24) / 274), 1, count), columns = count === 4 && fit === 3 ? 2 : fit;
    $("charts").style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
    return (room - 24 * (columns - 1)) / columns;
  }
  function charts() {
    const s = section(), n = frames(), box = $("charts"), width = chartWidth();
    const xOf = (i) => CHART.left + ((i + 0.5) * (width - CHART.left - CHART.right)) / n;
    const half = (width - CHART.left - CHART.right) / n / 2;
    let html = "";
    for (const key of Object.keys(data.metrics)) {
      const having = s.sources.filter((t) => metricsOf(t)?.[key]?.some((v) => v != null));
      if (!having.length) continue;
      const finite = having.flatMap((t) => metricsOf(t)[key]).filter((v) => typeof v === "number");
      let low = finite.length ? Math.min(...finite) : 0, high = finite.length ? Math.max(...finite) : 1;
      const pad = (high - low) * 0.08 || Math.abs(high) * 0.05 || 0.5;
      low -= pad; high += pad;
      if (data.metrics[key].digits > 2) low = Math.max(low, 0);
      const bottom = CHART.height - CHART.bottom, yOf = (v) => CHART.top + ((high - v) * (bottom - CHART.top)) / (high - low);
      const [marks, digits] = ticks(low, high);
      let svg = "";
      s.extrapolated.forEach((x, i) => { if (x) svg += `<rect class="band" x="${xOf(i) - half}" y="${CHART.top}" width="${2 * half}" height="${bottom - CHART.top}"/>`; });
      for (const v of marks) svg += `<line class="grid" x1="${CHART.left}" x2="${width - CHART.right}" y1="${yOf(v)}" y2="${yOf(v)}"/><text x="${CHART.left - 6}" y="${yOf(v) + 3.5}" text-anchor="end">${v.toFixed(digits)}</text>`;
      const every = Math.ceil(n / 12);
      s.frames.forEach((f, i) => { if (i % every === 0) svg += `<text x="${xOf(i)}" y="${CHART.height - 4}" text-anchor="middle">${f}</text>`; });
      svg += `<line class="now" y1="${CHART.top}" y2="${bottom}"/><line class="hover" y1="${CHART.top}" y2="${bottom}" visibility="hidden"/>`;
      for (const t of having) {
        let path = "", dots = "", pen = "M";
        metricsOf(t)[key].forEach((v, i) => {
          if (v === "inf") dots += `<text class="inf" x="${xOf(i)}" y="${CHART.top + 6}" text-anchor="middle">∞</text>`;
          if (typeof v !== "number") { pen = "M"; return; }
          path += `${pen}${xOf(i).toFixed(1)} ${yOf(v).toFixed(1)}`; pen = "L";
          if (n <= 60) dots += `<circle cx="${xOf(i).toFixed(1)}" cy="${yOf(v).toFixed(1)}" r="${n <= 30 ? 2.6 : 1.6}"/>`;
        });
        svg += `<g data-track="${escape(t.key)}" style="--c:${t.color}"><path d="${path}" stroke-dasharray="${t.dash || "none"}"/>${dots}</g>`;
      }
      const m = data.metrics[key];
      html += `<div class="chart" data-key="${key}"><header><b>${escape(m.label)}${m.unit ? ` [${escape(m.unit)}]` : ""}</b><span>${m.higher_is_better ? "higher" : "lower"} is better</span></header>
        <svg viewBox="0 0 ${width} ${CHART.height}" preserveAspectRatio="none" role="img" aria-label="${escape(m.label)} of every frame; the numbers are in the table below">${svg}</svg></div>`;
    }
    box.innerHTML = html;
    $("charts-key").hidden = !s.extrapolated.some(Boolean);
    const frameAt = (e, svg) => { const r = svg.getBoundingClientRect(); return clamp(Math.floor(((e.clientX - r.left) * (width / r.width) - CHART.left) / (2 * half)), 0, n - 1); };
    for (const chart of box.querySelectorAll(".chart")) {
      const svg = chart.querySelector("svg");
      svg.onpointermove = (e) => { hover = [frameAt(e, svg), chart.dataset.key, e.clientX, e.clientY]; hoverCharts(); };
      svg.onpointerleave = () => { hover = null; hoverCharts(); };
      svg.onclick = (e) => go(frameAt(e, svg));
    }
    chartState();
  }
  function chartState() {
    const width = chartWidth(), n = frames();
    const x = (i) => CHART.left + ((i + 0.5) * (width - CHART.left - CHART.right)) / n;
    for (const line of document.querySelectorAll(".chart .now")) { line.setAttribute("x1", x(state.frame)); line.setAttribute("x2", x(state.frame)); }
    for (const line of document.querySelectorAll(".chart .hover")) {
      line.setAttribute("visibility", hover ? "visible" : "hidden");
      if (hover) { line.setAttribute("x1", x(hover[0])); line.setAttribute("x2", x(hover[0])); }
    }
    for (const group of document.querySelectorAll(".chart g[data-track]")) group.classList.toggle("on", group.dataset.track === state.left || group.dataset.track === state.right);
  }
  function hoverCharts() {
    chartState();
    tip.hidden = !hover;
    if (!hover) return;
    const [i, key, px, py] = hover, s = section(), sign = data.metrics[key].higher_is_better ? -1 : 1;
    const rank = (v) => (v === "inf" ? Infinity : v == null ? -sign * Infinity * -1 : v);
    const list = s.sources.filter((t) => metricsOf(t)?.[key]).sort((a, b) => (sign * (rank(metricsOf(a)[key][i]) - rank(metricsOf(b)[key][i]))) || 0);
    tip.innerHTML = `<div class="head">${escape(data.metrics[key].label)}, frame ${s.frames[i]}${s.extrapolated[i] ? ", extrapolated" : ""}</div>` +
      list.map((t) => `<div><span><i class="swatch" style="--c:${t.color}"></i>${escape(t.name)}</span><b>${show(metricsOf(t)[key][i], key)}</b></div>`).join("");
    const r = tip.getBoundingClientRect();
    tip.style.left = `${px + 16 + r.width > innerWidth ? px - r.width - 16 : px + 16}px`;
    tip.style.top = `${clamp(py - r.height / 2, 6, innerHeight - r.height - 6)}px`;
  }

  // ---- building and updating
  function numbers() {
    const s = section(), keys = metricKeys();
    let html = "";
    for (const key of keys) {
      const m = data.metrics[key];
      html += `<table class="data"><thead><tr><th scope="col">${escape(m.label)}${m.unit ? ` [${escape(m.unit)}]` : ""}</th>${s.frames.map((f, i) => `<th scope="col">${f}${s.extrapolated[i] ? " ✕" : ""}</th>`).join("")}</tr></thead><tbody>` +
        s.tracks.filter((t) => metricsOf(t)?.[key]).map((t) => `<tr><th scope="row">${escape(t.name)}</th>${metricsOf(t)[key].map((v) => `<td>${show(v, key)}</td>`).join("")}</tr>`).join("") + "</tbody></table>";
    }
    $("numbers-body").innerHTML = html + (s.extrapolated.some(Boolean) ? '<p class="fine">✕: extrapolated frame.</p>' : "");
  }
  function build() {
    const s = section();
    if (data.sections.length <= 8) buttons($("sections"), data.sections.map((t, i) => [i, t.title]), state.section, (v) => enter(+v), "button");
    else {
      $("sections").innerHTML = `<select aria-label="Sequence and task">${data.sections.map((t, i) => `<option value="${i}">${escape(t.title)}</option>`).join("")}</select>`;
      $("sections").firstChild.value = state.section;
      $("sections").firstChild.onchange = (e) => enter(+e.target.value);
    }
    for (const b of $("sections").querySelectorAll("button")) b.setAttribute("aria-current", +b.dataset.value === state.section);
    $("sections").hidden = data.sections.length < 2;
    buttons($("views"), VIEWS.filter(([v]) => v !== "flip" || s.hasFlip), state.view, (v) => { state.view = v; update(); });
    $("scrub").max = frames() - 1;
    $("ticks").innerHTML = s.extrapolated.map((x, i) => `<i class="${x ? "x" : ""}${s.embedded[i] ? "" : " empty"}"></i>`).join("");
    s.columns = ["psnr", "flip"].filter((k) => s.tracks.some((t) => t.metrics[k]));
    $("sources").innerHTML = `<thead><tr><th scope="col">Compare</th><th scope="col">Left</th><th scope="col">Right</th>${s.columns.map((k) => `<th scope="col" class="n">${escape(data.metrics[k].label)}</th>`).join("")}</tr></thead><tbody>` + s.sources.map((t) =>
      `<tr data-key="${escape(t.key)}"><td title="${escape(t.note || "")}"><div><span class="swatch ${t.metrics ? "" : "none"}" style="--c:${t.color}"></span><span>${escape(t.name)}${t.note && !t.metrics ? `<small>${escape(t.note)}</small>` : ""}</span></div></td>` +
      ["left", "right"].map((side) => `<td><input type="radio" name="${side}" value="${escape(t.key)}" aria-label="${escape(t.name)} on the ${side}"></td>`).join("") + s.columns.map(() => '<td class="n"></td>').join("") + "</tr>").join("") + "</tbody>";
    for (const head of document.querySelectorAll(".result tbody th")) {
      const i = methods.indexOf(head.dataset.name);
      if (!head.querySelector(".swatch")) head.insertAdjacentHTML("afterbegin", `<span class="swatch" style="--c:var(--t${i % 10})"></span>`);
    }
    const subsets = s.subsets.map(([name, count]) => [name, `${name[0].toUpperCase()}${name.slice(1)} (${count})`]);
    if (!s.subsets.some(([name]) => name === state.subset)) state.subset = s.subsets[0][0];
    buttons($("subsets"), subsets, state.subset, (v) => { state.subset = v; update(); });
    $("subsets").hidden = subsets.length < 2;
    const regions = s.regions.map((name) => [name, name === "all" ? "All pixels" : `${name[0].toUpperCase()}${name.slice(1)}`]);
    if (!s.regions.includes(state.region)) state.region = "all";
    for (const element of document.querySelectorAll(".regions")) {
      buttons(element, regions, state.region, (v) => { state.region = v; numbers(); charts(); update(); });
      element.hidden = regions.length < 2;
    }
    $("results-title").textContent = "Results";
    $("results-facts").textContent = `${s.title} · ${n(frames(), "frame")} of ${s.size[0]}×${s.size[1]}`;
    $("numbers").hidden = false;
    numbers(); charts(); update();
    for (const src of s.sources) for (const index of src.images) if (index != null) picture(index);
  }
  function update() {
    const s = section(), src = { left: source(state.left), right: source(state.right) };
    chip($("chip-left"), state.view === "diff" ? { name: `|${src.left.name} − ${src.right.name}|` } : src.left);
    chip($("chip-right"), src.right);
    $("chip-right").hidden = state.view === "diff";
    for (const side of ["left", "right"]) for (const input of document.querySelectorAll(`input[name="${side}"]`)) input.checked = input.value === state[side];
    for (const row of $("sources").querySelectorAll("tbody tr")) {
      const t = source(row.dataset.key);
      row.querySelectorAll("td.n").forEach((td, i) => { const values = metricsOf(t)?.[s.columns[i]]; td.textContent = values ? show(values[state.frame], s.columns[i]) : ""; });
    }
    $("sources-frame").textContent = `PSNR and FLIP of frame ${s.frames[state.frame]}${state.region === "all" ? "" : `, ${state.region} alone`}`;
    for (const element of document.querySelectorAll(".regions")) mark(element, state.region);
    mark($("views"), state.view); mark($("subsets"), state.subset); mark($("zooms"), state.zoom);
    $("scale-box").hidden = state.view === "image"; $("legend").hidden = state.view === "image";
    $("scale").value = state.scale; $("fps").value = state.fps;
    $("legend-name").textContent = { error: "|difference| to truth", flip: "FLIP", diff: "|left − right|" }[state.view] || "";
    $("legend-max").textContent = state.scale < 1 ? `≥ ${state.scale}` : "1";
    $("scrub").value = state.frame;
    $("scrub").setAttribute("aria-valuetext", `frame ${s.frames[state.frame]}${s.extrapolated[state.frame] ? ", extrapolated" : ""}`);
    $("frame-name").innerHTML = `${s.frames[state.frame]} <span style="color:var(--muted)">of ${s.frames[frames() - 1]}</span>${s.extrapolated[state.frame] ? " <em>extrapolated</em>" : ""}`;
    [...$("ticks").children].forEach((t, i) => t.classList.toggle("on", i === state.frame));
    let means = 0;
    for (const el of document.querySelectorAll(".result")) {
      const here = el.dataset.task === undefined ? +el.dataset.section === state.section : el.dataset.task === s.task;
      el.hidden = !here || el.dataset.subset !== state.subset || el.dataset.region !== state.region;
      if (!el.hidden && el.dataset.task !== undefined) means += 1;
    }
    $("means-title").hidden = !means;
    $("means-title").textContent = `Mean over ${n(data.sections.filter((t) => t.task === s.task).length, "sequence")} · ${s.task}`;
    handle.setAttribute("aria-valuenow", Math.round(100 * state.split));
    handle.setAttribute("aria-valuetext", `${src.left.name} ${Math.round(100 * state.split)} percent, ${src.right.name} the rest`);
    $("play").innerHTML = playing ? '<svg viewBox="0 0 16 16" aria-hidden="true"><path d="M4 3h3v10H4zM9 3h3v10H9z"/></svg>' : '<svg viewBox="0 0 16 16" aria-hidden="true"><path d="M4 2.5 13 8l-9 5.5z"/></svg>';
    $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    chartState(); draw();
    clearTimeout(update.timer);
    update.timer = setTimeout(() => history.replaceState(null, "", "#" + hash()), playing ? 400 : 60);
  }
  function hash() {
    const p = new URLSearchParams({ section: state.section, frame: section().frames[state.frame], left: state.left, right: state.right, view: state.view });
    if (state.view !== "image") p.set("scale", state.scale);
    if (state.zoom) { p.set("zoom", state.zoom); p.set("x", state.x.toFixed(4)); p.set("y", state.y.toFixed(4)); }
    if (Math.abs(state.split - 0.5) > 1e-3) p.set("split", state.split.toFixed(3));
    if (section().subsets.length > 1) p.set("subset", state.subset);
    if (state.region !== "all") p.set("region", state.region);
    return p.toString();
  }
  function defaults() {
    const s = section(), n = frames(), middle = Math.floor(n / 2);
    state.left = s.tracks[0].key; state.right = s.tracks.length > 1 ? s.tracks[s.tracks.length - 1].key : "truth";
    const shown = s.frames.map((_, i) => i).filter((i) => s.embedded[i]).sort((a, b) => Math.abs(a - middle) - Math.abs(b - middle));
    state.frame = shown.find((i) => s.extrapolated[i]) ?? shown[0];
    state.subset = s.subsets[0][0];
  }
  function enter(index) {
    const old = section(), keys = [state.left, state.right], frame = old.frames[state.frame];
    state.section = index;
    defaults();
    if (source(keys[0]) && source(keys[1])) [state.left, state.right] = keys;
    const same = section().frames.indexOf(frame);
    if (same >= 0) state.frame = same;
    if (state.view === "flip" && !section().hasFlip) state.view = "error";
    build();
  }
  function readHash() {
    const p = new URLSearchParams(location.hash.slice(1)), num = (k, low, high) => (p.has(k) && isFinite(+p.get(k)) ? clamp(+p.get(k), low, high) : null);
    state.section = Math.round(num("section", 0, data.sections.length - 1) ?? 0);
    defaults();
    const at = section().frames.indexOf(num("frame", -1e9, 1e9));
    if (at >= 0) state.frame = at;
    for (const side of ["left", "right"]) if (source(p.get(side))) state[side] = p.get(side);
    state.view = VIEWS.some(([v]) => v === p.get("view")) && (p.get("view") !== "flip" || section().hasFlip) ? p.get("view") : "image";
    if (SCALES.includes(num("scale", 0, 1))) state.scale = num("scale", 0, 1);
    state.zoom = num("zoom", 0, 8) ?? 0; state.x = num("x", 0, 1) ?? 0.5; state.y = num("y", 0, 1) ?? 0.5; state.split = num("split", 0, 1) ?? 0.5;
    if (section().subsets.some(([name]) => name === p.get("subset"))) state.subset = p.get("subset");
    state.region = section().regions.includes(p.get("region")) ? p.get("region") : "all";
    build();
  }

  // ---- control
  function go(frame) { state.frame = (frame + frames()) % frames(); update(); }
  function step(direction) { // to the next frame that has images
    let f = state.frame;
    do f = (f + direction + frames()) % frames(); while (!section().embedded[f] && f !== state.frame);
    go(f);
  }
  function play(on) {
    clearInterval(playing);
    playing = on ? setInterval(() => step(1), 1000 / state.fps) : 0;
    update();
  }
  function swap() { [state.left, state.right] = [state.right, state.left]; update(); }
  $("previous").onclick = () => step(-1);
  $("next").onclick = () => step(1);
  $("play").onclick = () => play(!playing);
  $("scrub").oninput = (e) => go(+e.target.value);
  $("scale").innerHTML = SCALES.map((v) => `<option value="${v}">${v}</option>`).join("");
  $("scale").onchange = (e) => { state.scale = +e.target.value; update(); };
  $("fps").innerHTML = FPS.map((v) => `<option value="${v}">${v} fps</option>`).join("");
  $("fps").onchange = (e) => { state.fps = +e.target.value; if (playing) play(true); };
  $("sources").onchange = (e) => { state[e.target.name] = e.target.value; update(); };
  $("ticks").onclick = (e) => { const i = [...$("ticks").children].indexOf(e.target); if (i >= 0) go(i); };
  buttons($("zooms"), [["0", "Fit", "Largest whole zoom that fits (0)"], ...[1, 2, 4, 8].map((v) => [String(v), `${v}×`, `Zoom ${v} (key ${v})`])], state.zoom, (v) => setZoom(+v), "button");
  $("theme").onclick = () => {
    const root = document.documentElement, dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
    draw();
  };
  $("copy").onclick = async () => {
    history.replaceState(null, "", "#" + hash());
    try { await navigator.clipboard.writeText(location.href); $("copy").textContent = "Copied"; } catch { $("copy").textContent = "Link is in the address bar"; }
    setTimeout(() => { $("copy").textContent = "Copy link"; }, 1600);
  };
  let drag = null;
  const local = (e) => { const r = stage.getBoundingClientRect(); return [e.clientX - r.left, e.clientY - r.top]; };
  stage.addEventListener("pointerdown", (e) => {
    if (e.button) return;
    const [x, y] = local(e), near = Math.abs(x - state.split * stage.clientWidth) < 16 && state.view !== "diff";
    drag = near || !stage.classList.contains("grab") ? { split: true } : { x, y, sx: state.x, sy: state.y };
    stage.setPointerCapture(e.pointerId);
    if (drag.split) state.split = clamp(x / stage.clientWidth, 0, 1);
    stage.classList.toggle("grabbing", !drag.split);
    update();
  });
  stage.addEventListener("pointermove", (e) => {
    pointer = local(e);
    if (drag?.split) { state.split = clamp(pointer[0] / stage.clientWidth, 0, 1); update(); }
    else if (drag) {
      const [w, h] = section().size, z = zoom(), rx = stage.clientWidth / (2 * w * z), ry = stage.clientHeight / (2 * h * z);
      const inside = (v, r) => (r >= 0.5 ? 0.5 : clamp(v, r, 1 - r));
      state.x = inside(drag.sx - (pointer[0] - drag.x) / (w * z), rx); state.y = inside(drag.sy - (pointer[1] - drag.y) / (h * z), ry);
      update();
    } else draw();
  });
  for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, () => { drag = null; stage.classList.remove("grabbing"); });
  stage.addEventListener("pointerleave", () => { pointer = null; draw(); });
  stage.addEventListener("wheel", (e) => { e.preventDefault(); stepZoom(e.deltaY < 0 ? 1 : -1, ...local(e)); }, { passive: false });
  stage.addEventListener("dblclick", () => setZoom(0));
  handle.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[e.key];
    if (!step) return;
    e.preventDefault(); e.stopPropagation();
    state.split = clamp(state.split + step, 0, 1); update();
  });
  addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const tag = e.target.tagName, typing = tag === "SELECT" || (tag === "INPUT" && e.target.type === "radio" && e.key.startsWith("Arrow"));
    if (typing || (e.target.id === "scrub" && e.key.startsWith("Arrow"))) return;
    if (e.key === " " && (tag === "BUTTON" || tag === "SUMMARY" || (tag === "INPUT" && e.target.type === "radio"))) return;
    const views = VIEWS.map(([v]) => v).filter((v) => v !== "flip" || section().hasFlip);
    const act = {
      ArrowLeft: () => step(-1), ArrowRight: () => step(1), " ": () => play(!playing), x: swap,
      Home: () => go(0), End: () => go(frames() - 1), "+": () => stepZoom(1), "-": () => stepZoom(-1),
      v: () => { state.view = views[(views.indexOf(state.view) + 1) % views.length]; update(); },
      "[": () => { state.split = clamp(state.split - 0.02, 0, 1); update(); }, "]": () => { state.split = clamp(state.split + 0.02, 0, 1); update(); },
    }[e.key] || (/^[0-8]$/.test(e.key) ? () => setZoom(+e.key) : null);
    if (act) { e.preventDefault(); act(); }
  });
  addEventListener("hashchange", readHash);
  new ResizeObserver(() => { charts(); draw(); }).observe(document.querySelector("main"));

  const bar = $("legend-bar").getContext("2d");
  for (let i = 0; i < 256; i++) { bar.fillStyle = `rgb(${LUT.slice(3 * i, 3 * i + 3)})`; bar.fillRect(i, 0, 1, 1); }
  $("viewer").hidden = false; $("side").hidden = false; $("curves").hidden = false;
  readHash();
})();
