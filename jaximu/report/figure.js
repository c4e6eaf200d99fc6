// Zoom, and the value under the pointer, in a report's figures. It asks no other machine for anything, and keeps nothing.
(() => {
  const MOST = 40, NEAR = 24;
  const written = (value) => String(value || 0).replaceAll("-", "−");
  const numbers = (text) => text.split(" ").filter(Boolean).map(Number).filter(Number.isFinite);

  function at(axis, share) {
    const [low, high] = axis.ends;
    return axis.scale === "log" ? low * (high / low) ** share : low + (high - low) * share;
  }

  function said(axis, value) {
    if (axis.scale === "date") return new Date(value * 864e5).toISOString().slice(0, 16).replace("T", " ");
    if (!axis.words && !axis.unit) return "";
    if (axis.names) return axis.names[Math.round(value)] || "";
    const [low, high] = axis.ends, digits = 3 - Math.floor(Math.log10(Math.abs(high - low))); // as fine as it is drawn
    const rounded = axis.scale === "log" || digits > 20 ? value.toPrecision(3) : value.toFixed(Math.max(0, digits));
    return [axis.words, written(Number(rounded)), axis.unit || ""].filter(Boolean).join(" ");
  }

  // Points of a panel: centres of marks, and vertices of lines and bars, as they are drawn.
  function marks(group) {
    const found = [];
    for (const artist of group.querySelectorAll("[data-name]")) {
      const names = JSON.parse(artist.dataset.names || "[]"), name = artist.dataset.name;
      const centres = artist.querySelectorAll("use");
      centres.forEach((each, place) => found.push({ x: +each.getAttribute("x"), y: +each.getAttribute("y"), name: names[place] || name }));
      if (centres.length) continue;
      for (const path of artist.querySelectorAll("path")) {
        const all = numbers(path.getAttribute("d"));
        for (let place = 0; place + 1 < all.length; place += 2) found.push({ x: all[place], y: all[place + 1], name });
      }
    }
    return found;
  }

  function words(panel, spot, mark) {
    const lines = [mark ? mark.name : ""], { x, y, grid, box: [left, top, right, bottom] } = panel;
    if (x) {
      const across = at(x, (spot.x - left) / (right - left)), up = at(y, (bottom - spot.y) / (bottom - top));
      lines.push(said(x, across), said(y, up));
      const row = grid && grid[Math.round(up)];
      if (row && row[Math.round(across)] !== undefined) lines.push(written(row[Math.round(across)]));
    }
    return lines.filter(Boolean).join("\n");
  }

  function start(picture) {
    const svg = picture.querySelector("svg"), { width, height } = svg.viewBox.baseVal;
    const panels = [...svg.querySelectorAll("[data-panel]")].map((group) => ({ ...JSON.parse(group.dataset.panel), group }));
    const dots = [...svg.querySelectorAll("defs > path")].filter((each) => numbers(each.getAttribute("d")).every((n) => Math.abs(n) < 30));
    const ring = document.createElementNS(svg.namespaceURI, "circle");
    const tip = document.createElement("div"), tools = document.createElement("div");
    let view = { x: 0, y: 0, k: 1 }, drag = null, step = -1;
    ring.setAttribute("class", "ring");
    svg.append(ring);
    tip.className = "tip";
    tip.setAttribute("role", "status");
    tools.className = "tools";
    picture.append(tip, tools);
    picture.tabIndex = 0;

    function look(x, y, k) {
      k = Math.min(Math.max(k, 1), MOST);
      view = { x: Math.min(Math.max(x, 0), width - width / k), y: Math.min(Math.max(y, 0), height - height / k), k };
      svg.setAttribute("viewBox", `${view.x} ${view.y} ${width / k} ${height / k}`);
      picture.classList.toggle("zoomed", k > 1);
      for (const each of dots) each.setAttribute("transform", `scale(${1 / k})`); // marks part, as they do not grow
      hide();
    }
    function zoom(factor, spot = { x: view.x + width / view.k / 2, y: view.y + height / view.k / 2 }) {
      const k = Math.min(Math.max(view.k * factor, 1), MOST), share = view.k / k;
      look(spot.x - (spot.x - view.x) * share, spot.y - (spot.y - view.y) * share, k);
    }
    const place = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    function hide() {
      tip.style.display = ring.style.display = "none";
    }

    function show(panel, spot, mark) {
      const text = words(panel, mark || spot, mark);
      hide();
      if (!text) return;
      const screen = svg.getScreenCTM(), frame = picture.getBoundingClientRect(), { x, y } = mark || spot;
      const left = screen.a * x + screen.e - frame.left + picture.scrollLeft, top = screen.d * y + screen.f - frame.top;
      tip.textContent = text;
      tip.style.display = "block";
      tip.style.left = `${Math.max(0, Math.min(left + 12, picture.scrollLeft + frame.width - tip.offsetWidth))}px`;
      tip.style.top = `${top > tip.offsetHeight + 12 ? top - tip.offsetHeight - 12 : top + 12}px`;
      if (!mark) return;
      for (const [key, value] of [["cx", x], ["cy", y], ["r", 6 / screen.a]]) ring.setAttribute(key, value);
      ring.style.display = "block";
    }
    function hover(event) {
      const spot = place(event), near = NEAR / svg.getScreenCTM().a;
      const panel = panels.find(({ box: [left, top, right, bottom] }) => left <= spot.x && spot.x <= right && top <= spot.y && spot.y <= bottom);
      if (!panel) return hide();
      panel.marks ||= marks(panel.group);
      let best = null, least = near;
      for (const each of panel.marks) {
        const far = Math.hypot(each.x - spot.x, each.y - spot.y);
        if (far < least && (each.name || panel.x)) [best, least] = [each, far];
      }
      show(panel, spot, best);
    }

    picture.addEventListener("pointerdown", (event) => {
      if (view.k > 1 && !tools.contains(event.target)) {
        drag = { x: event.clientX, y: event.clientY, view };
        picture.setPointerCapture(event.pointerId);
      } else hover(event);
    });
    picture.addEventListener("pointermove", (event) => {
      if (!drag) return tools.contains(event.target) ? hide() : hover(event);
      const scale = svg.getScreenCTM().a;
      look(drag.view.x - (event.clientX - drag.x) / scale, drag.view.y - (event.clientY - drag.y) / scale, drag.view.k);
    });
    for (const end of ["pointerup", "pointercancel"]) picture.addEventListener(end, () => (drag = null));
    picture.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && hide());
    picture.addEventListener("blur", hide);
    picture.addEventListener("dblclick", (event) => tools.contains(event.target) || look(0, 0, 1));
    picture.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey && document.activeElement !== picture) return; // the page scrolls
      event.preventDefault();
      zoom(event.deltaY < 0 ? 1.25 : 0.8, place(event));
    }, { passive: false });

    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    picture.addEventListener("keydown", (event) => {
      const way = ways[event.key];
      if (event.target !== picture || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "+" || event.key === "=") zoom(1.5);
      else if (event.key === "-") zoom(1 / 1.5);
      else if (event.key === "0" || event.key === "Escape") look(0, 0, 1);
      else if (way && view.k > 1) look(view.x + (way[0] * width) / view.k / 8, view.y + (way[1] * height) / view.k / 8, view.k);
      else if (way && way[0]) {
        const all = panels.flatMap((panel) => (panel.marks ||= marks(panel.group)).map((mark) => ({ panel, mark })));
        if (!all.length) return;
        const stride = Math.ceil(all.length / 200); // of a long trace not every sample
        step = (step + way[0] * stride + all.length) % all.length;
        show(all[step].panel, null, all[step].mark);
      } else return;
      event.preventDefault();
    });
    for (const [sign, about, act] of [["+", "zoom in", () => zoom(1.5)], ["−", "zoom out", () => zoom(1 / 1.5)], ["↺", "show all", () => look(0, 0, 1)]]) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: sign, title: about, onclick: act });
      button.setAttribute("aria-label", about);
      tools.append(button);
    }
    addEventListener("beforeprint", () => look(0, 0, 1));
    hide();
  }
  document.querySelectorAll(".picture").forEach(start);
})();
