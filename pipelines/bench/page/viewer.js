"use strict";
// GALLERY: { scene: { width, height, images: [{ method, label, src }] } }. One view, shared by all panes: the point of
// the image in the middle of each pane, and its zoom relative to fitting the pane.
(() => {
  const byId = (id) => document.getElementById(id);
  const scenes = Object.keys(GALLERY);
  const panes = byId("panes");
  const state = { scene: scenes[0], method: 0, grid: false, zoom: 1, x: 0.5, y: 0.5 };
  const MOST = 64;

  const images = () => GALLERY[state.scene].images;
  const fit = (pane) => {
    const { width, height } = GALLERY[state.scene];
    return Math.min(pane.clientWidth / width, pane.clientHeight / height);
  };

  function place() {
    const { width, height } = GALLERY[state.scene];
    for (const pane of panes.children) {
      const scale = fit(pane) * state.zoom;
      const left = pane.clientWidth / 2 - state.x * width * scale;
      const top = pane.clientHeight / 2 - state.y * height * scale;
      pane.firstChild.style.transform = `translate(${left}px, ${top}px) scale(${scale})`;
      // Pixels as squares when enlarged; made smaller, a choice of pixels would show noise that is not there.
      pane.firstChild.style.imageRendering = scale * window.devicePixelRatio < 1 ? "auto" : "pixelated";
    }
    byId("zoom").textContent = `${Math.round(100 * state.zoom)} %`;
  }

  function show(pane, image) {
    pane.firstChild.src = image.src;
    pane.firstChild.alt = `${state.scene}, ${image.method}`;
    pane.lastChild.textContent = image.label;
    pane.dataset.method = image.method;
  }

  function draw() {
    const shown = state.grid ? images() : [images()[state.method]];
    while (panes.children.length > shown.length) panes.lastChild.remove();
    while (panes.children.length < shown.length) panes.append(makePane());
    shown.forEach((image, index) => show(panes.children[index], image));
    panes.classList.toggle("grid", state.grid);
    byId("grid").setAttribute("aria-pressed", String(state.grid));
    const buttons = byId("methods");
    buttons.replaceChildren(...images().map((image, index) => {
      const button = document.createElement("button");
      button.textContent = (index < 9 ? `${index + 1} ` : "") + image.method;
      button.dataset.method = image.method;
      button.setAttribute("aria-pressed", String(index === state.method));
      button.addEventListener("click", () => flip(index));
      return button;
    }));
    place();
  }

  function flip(index) {
    state.method = (index + images().length) % images().length;
    state.grid = false;
    draw();
  }

  function zoomAt(pane, clientX, clientY, factor) {
    const box = pane.getBoundingClientRect();
    const { width, height } = GALLERY[state.scene];
    const dx = clientX - box.left - pane.clientWidth / 2;
    const dy = clientY - box.top - pane.clientHeight / 2;
    const before = fit(pane) * state.zoom;
    state.zoom = Math.min(Math.max(state.zoom * factor, 1), MOST);
    const after = fit(pane) * state.zoom;
    move(dx / before / width - dx / after / width, dy / before / height - dy / after / height);
  }

  function move(dx, dy) {
    state.x = Math.min(Math.max(state.x + dx, 0), 1);
    state.y = Math.min(Math.max(state.y + dy, 0), 1);
    if (state.zoom === 1) state.x = state.y = 0.5;
    place();
  }

  function makePane() {
    const pane = document.createElement("div");
    pane.className = "pane";
    pane.append(document.createElement("img"), document.createElement("span"));
    pane.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoomAt(pane, event.clientX, event.clientY, Math.exp(-event.deltaY / 300));
    }, { passive: false });
    pane.addEventListener("pointerdown", (event) => {
      pane.setPointerCapture(event.pointerId);
      pane.classList.add("held");
    });
    pane.addEventListener("pointermove", (event) => {
      if (!pane.classList.contains("held")) return;
      const { width, height } = GALLERY[state.scene];
      const scale = fit(pane) * state.zoom;
      move(-event.movementX / scale / width, -event.movementY / scale / height);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      pane.addEventListener(end, () => pane.classList.remove("held"));
    }
    return pane;
  }

  const choice = byId("scene");
  choice.append(...scenes.map((scene) => new Option(scene, scene)));
  choice.addEventListener("change", () => {
    const method = images()[state.method].method;
    state.scene = choice.value;
    const same = images().findIndex((image) => image.method === method);
    Object.assign(state, { method: Math.max(same, 0), zoom: 1, x: 0.5, y: 0.5 });
    draw();
  });
  byId("grid").addEventListener("click", () => { state.grid = !state.grid; draw(); });
  byId("fit").addEventListener("click", () => { Object.assign(state, { zoom: 1, x: 0.5, y: 0.5 }); place(); });
  window.addEventListener("keydown", (event) => {
    if (event.target === choice || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "ArrowRight") flip(state.method + 1);
    else if (event.key === "ArrowLeft") flip(state.method - 1);
    else if (/^[1-9]$/.test(event.key) && Number(event.key) <= images().length) flip(Number(event.key) - 1);
  });
  window.addEventListener("resize", place);
  draw();
})();
