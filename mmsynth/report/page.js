"use strict";
// Wipes, zoom, and the light of a pixel. A row of pictures that has spectra names the script element that holds them.
(() => {
  const NONE = 65535; // no ray through this pixel
  const held = new Map(); // what was decoded, by the name of its element
  const number = (value) => (Number.isNaN(value) ? "–" : value.toFixed(4));

  function element(tag, name, text) {
    const made = document.createElement(tag);
    if (name) made.className = name;
    if (text !== undefined) made.textContent = text;
    return made;
  }

  function spectraOf(row) {
    const name = row.dataset.spectra;
    if (!held.has(name)) {
      const stored = JSON.parse(document.getElementById(name).textContent);
      const decode = (text) => text && new Uint16Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
      for (const key of ["measured", "rendered", "deviation"]) stored[key] = decode(stored[key]);
      held.set(name, { ...stored, at: [stored.width >> 1, stored.height >> 1] });
    }
    return held.get(name);
  }

  function light(data, key, [x, y]) {
    const start = (y * data.width + x) * data.channels.length;
    const value = (q) => (q === NONE ? NaN : data.low + (q / (NONE - 1)) * (data.high - data.low));
    return data[key] && Array.from(data[key].subarray(start, start + data.channels.length), value);
  }

  // channels with wavelengths by these, others one after the other
  function plot(data, of) {
    const waves = data.nm.map((nm, i) => [nm, i]).filter(([nm]) => nm !== null);
    const order = waves.length > 1 ? waves.sort((a, b) => a[0] - b[0]) : data.channels.map((_, i) => [i, i]);
    const [first, last] = [order[0][0], order[order.length - 1][0]];
    const x = (place) => (last > first ? 26 + (214 * (place - first)) / (last - first) : 133);
    const y = (value) => 88 - (78 * (value - data.low)) / (data.high - data.low || 1);
    let out = `<path class="axis" d="M26 8V88H244"/><text x="0" y="14">${data.high.toPrecision(2)}</text><text x="0" y="90">${data.low.toPrecision(2)}</text>`;
    if (waves.length > 1) out += `<text x="26" y="101">${first} nm</text><text x="205" y="101">${last} nm</text>`;
    for (const [key, values] of Object.entries(of)) {
      const known = values ? order.filter(([, i]) => !Number.isNaN(values[i])) : [];
      const bar = ([place, i]) => `<path class="rendered unsure" d="M${x(place)} ${y(of.rendered[i] - values[i])}V${y(of.rendered[i] + values[i])}"/>`;
      if (key === "deviation") out += known.map(bar).join("");
      else if (known.length && waves.length > 1) out += `<path class="${key}" d="M${known.map(([place, i]) => `${x(place)} ${y(values[i])}`).join("L")}"/>`;
      for (const [place, i] of key === "deviation" ? [] : known) out += `<circle class="${key}" fill="${key === "measured" ? "currentColor" : "none"}" cx="${x(place)}" cy="${y(values[i])}" r="2.5"/>`;
    }
    return `<svg viewBox="0 0 250 104" aria-hidden="true">${out}</svg>`;
  }

  // aloud: said to those who listen, when keys moved the pixel
  function show(row, aloud) {
    const data = spectraOf(row), box = row.querySelector(".readout"), [x, y] = data.at;
    const of = { measured: light(data, "measured", data.at), rendered: light(data, "rendered", data.at), deviation: light(data, "deviation", data.at) };
    const named = Object.entries(of).filter(([, values]) => values);
    const [wide, high] = data.cell, table = element("table"), body = element("tbody");
    const place = wide * high >= 2 ? `mean of about ${wide.toFixed(0)} x ${high.toFixed(0)} pixels around column ${((x + 0.5) * wide).toFixed(0)}, row ${((y + 0.5) * high).toFixed(0)}` : `column ${Math.floor((x + 0.5) * wide)}, row ${Math.floor((y + 0.5) * high)}`;
    body.append(element("tr"));
    body.lastChild.append(element("td", "", "light [full scale]"), ...data.channels.map((name) => element("th", "number", name)));
    for (const [key, values] of named) {
      const line = element("tr");
      line.dataset.key = key;
      line.append(element("th", key, key === "rendered" && !of.measured ? "predicted" : key), ...values.map((v) => element("td", "number", number(v))));
      body.append(line);
    }
    table.append(body);
    const scroll = element("div", "scroll"), both = element("div", "plot");
    scroll.append(element("p", "where", place), table);
    both.innerHTML = plot(data, of);
    both.append(scroll);
    box.replaceChildren(both);
    if (aloud) spoken.textContent = `${place}: ` + named.map(([key, values]) => `${key} ${values.map((v, i) => `${data.channels[i]} ${number(v)}`).join(", ")}`).join("; ");
    for (const look of row.querySelectorAll(".look")) {
      let mark = look.querySelector(".mark");
      if (!mark) look.append((mark = element("span", "mark")));
      Object.assign(mark.style, { left: `${(100 * x) / data.width}%`, top: `${(100 * y) / data.height}%`, width: `${100 / data.width}%`, height: `${100 / data.height}%` });
    }
  }

  function move(row, x, y, aloud) {
    const data = spectraOf(row), inside = (value, size) => Math.min(Math.max(Math.floor(value), 0), size - 1);
    data.at = [inside(x, data.width), inside(y, data.height)];
    show(row, aloud);
  }

  function enlarge(look) {
    const row = look.closest("[data-spectra]"), inner = element("div"), close = element("button", "", "Close");
    close.onclick = () => dialog.close();
    inner.append(close, look.closest("figure").cloneNode(true));
    if (row) {
      inner.dataset.spectra = row.dataset.spectra;
      inner.append(element("div", "readout"));
    }
    dialog.replaceChildren(inner, spoken);
    dialog.setAttribute("aria-label", look.dataset.alt);
    dialog.showModal();
    inner.querySelector(".look").focus();
    if (row) show(inner);
  }

  const dialog = element("dialog"), spoken = element("p");
  spoken.setAttribute("aria-live", "polite");
  spoken.style.cssText = "position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%)";
  dialog.onclose = () => document.body.append(spoken);
  document.body.append(dialog, spoken);
  document.documentElement.classList.add("js");
  for (const look of document.querySelectorAll(".look")) {
    look.tabIndex = 0;
    look.setAttribute("role", "button");
    look.setAttribute("aria-label", `${look.dataset.alt}: enlarge`);
  }
  document.querySelectorAll("[data-spectra]").forEach((row) => show(row));

  document.addEventListener("input", (event) => {
    if (event.target.matches(".wipe input")) event.target.closest(".wipe").style.setProperty("--at", `${event.target.value}%`);
  });
  document.addEventListener("pointermove", (event) => {
    const look = event.target.closest(".look"), row = look && look.closest("[data-spectra]");
    if (!row) return;
    const box = look.getBoundingClientRect(), data = spectraOf(row);
    move(row, ((event.clientX - box.left) / box.width) * data.width, ((event.clientY - box.top) / box.height) * data.height);
  });
  document.addEventListener("click", (event) => {
    const look = event.target.closest(".look");
    if (event.target === dialog) dialog.close();
    else if (look && !dialog.contains(look)) enlarge(look);
  });
  document.addEventListener("keydown", (event) => {
    const look = event.target.closest(".look"), row = look && look.closest("[data-spectra]");
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (look && !dialog.contains(look) && (event.key === "Enter" || event.key === " ")) enlarge(look);
    else if (row && step) move(row, spectraOf(row).at[0] + step[0], spectraOf(row).at[1] + step[1], true);
    else return;
    event.preventDefault();
  });
})();
