// The 3-D view of a report page: reads what the page holds, asks nobody. Names go into text nodes alone.
"use strict";
(async () => {
  const root = document.getElementById("viewer");
  const problem = document.getElementById("viewer-problem");
  const began = performance.now();
  const reduced = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const $ = (id) => document.getElementById(id);
  const MARK_COLOURS = { fold: "#d900f2", overlap: "#0059ff", "inverted tet": "#ff7a00", "contact zone": "#00a3a3" };
  const SEQUENTIAL = ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"];
  const DIVERGING = ["#542788", "#b2abd2", "#f7f7f7", "#fdb863", "#b35806"];
  const NOT_A_NUMBER = "#9a9a9a";

  // ---- what the page holds ----------------------------------------------------------------------------------------

  async function unpacked(text) {
    const packed = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // Signed whole numbers, row by row, from byte planes of the columns: themselves, or differences down the columns.
  function words(bytes, [at, rows, columns, planes], running = true) {
    const count = rows * columns;
    const out = new Int32Array(count);
    for (let c = 0; c < columns; c++) {
      let value = 0;
      for (let r = 0; r < rows; r++) {
        let folded = 0;
        for (let p = planes - 1; p >= 0; p--) folded = folded * 256 + bytes[at + p * count + c * rows + r];
        const step = folded % 2 ? -(folded + 1) / 2 : folded / 2;
        value = running ? value + step : step;
        out[r * columns + c] = value;
      }
    }
    return out;
  }

  function floats(bytes, [at, count]) {
    return new Float32Array(bytes.slice(at, at + 4 * count).buffer);
  }

  // Whole-number positions (modulo 65536) of every shape, each from the guess that it names.
  function positionsOf(scene, bytes) {
    const known = [];
    for (const shape of scene.shapes) {
      const steps = words(bytes, shape.positions);
      const out = new Uint16Array(steps.length);
      const [how, one, two] = shape.guess;
      if (how === "nothing") for (let i = 0; i < out.length; i++) out[i] = steps[i];
      else if (how === "shape") for (let i = 0; i < out.length; i++) out[i] = steps[i] + known[one][i];
      else if (how === "line") for (let i = 0; i < out.length; i++) out[i] = steps[i] + 2 * known[two][i] - known[one][i];
      else firstOf(scene, shape, (i, j) => { out[i] = steps[i] + known[0][j]; });
      known.push(out);
    }
    return known;
  }

  // Whether each tissue of a shape has no more vertices than in the first: those given, which come first there.
  function isFirstOf(shape) {
    const theirs = scene.topologies[scene.shapes[0].topology].vertices;
    return scene.topologies[shape.topology].vertices.every((count, t) => count <= theirs[t]);
  }

  // Calls back with each coordinate of a shape and that of the same vertex in the first shape, which has more of them.
  function firstOf(scene, shape, told) {
    const mine = scene.topologies[shape.topology].vertices;
    const theirs = scene.topologies[scene.shapes[0].topology].vertices;
    let i = 0, start = 0;
    mine.forEach((count, t) => {
      for (let k = 0; k < 3 * count; k++) told(i++, start + k);
      start += 3 * theirs[t];
    });
  }

  const THREE_D = globalThis.THREE;
  let scene, bytes, whole, renderer;
  try {
    if (!globalThis.DecompressionStream) throw new Error("this browser cannot unpack it (no DecompressionStream)");
    scene = JSON.parse($("scene").textContent);
    bytes = await unpacked($("scene-data").textContent);
    whole = positionsOf(scene, bytes);
    renderer = new THREE_D.WebGLRenderer({ canvas: $("view"), antialias: true, alpha: true, preserveDrawingBuffer: true });
  } catch (error) {
    problem.textContent = `No 3-D here: ${error.message}. The pictures show the same.`;
    document.documentElement.dataset.viewer = "none";
    return;
  }
  problem.hidden = true;
  root.hidden = false;
  renderer.localClippingEnabled = true;
  renderer.autoClear = false;

  // The triangles of each tissue: those that it shares with others read before, then its own (triangle_coding.py).
  const topologies = [];
  for (const topology of scene.topologies) {
    const runs = words(bytes, topology.runs, false), first = words(bytes, topology.first), others = words(bytes, topology.others, false);
    const parts = [];
    let v = 0, own = 0, before = -1, last = 0, run = 0, left = runs.length ? runs[0] : 0;
    scene.tissues.forEach((_, t) => {
      const index = new Uint32Array(3 * topology.triangles[t]);
      let at = 0;
      if (topology.base !== null) {
        const theirs = topologies[topology.base][t].index;
        for (let f = 0; f < theirs.length; f += 3) {
          while (!left) left = runs[++run];
          left--;
          if (run % 2 === 0) { index.set(theirs.subarray(f, f + 3), at); at += 3; }
        }
      }
      for (; at < index.length; at += 3, own++) {
        const a = first[own], b = others[2 * own] + (a === before ? last : a), c = others[2 * own + 1] + a;
        index[at] = a; index[at + 1] = b; index[at + 2] = c;
        before = a; last = c;
      }
      parts.push({ v0: v, v1: v + topology.vertices[t], index });
      v += topology.vertices[t];
    });
    topologies.push(parts);
  }
  const millimetres = (q, k) => scene.origin[k % 3] + scene.quantum * q;

  // ---- what is shown ----------------------------------------------------------------------------------------------

  const frames = scene.shapes.map((s, k) => k).filter((k) => scene.shapes[k].time_s !== null);
  const motions = [...new Set(frames.map((k) => scene.shapes[k].motion))];
  const times = [...new Set(frames.map((k) => Math.round(1e6 * scene.shapes[k].time_s) / 1e6))].sort((a, b) => a - b);
  // The frame of a motion that is shown at the time of the slider: the last that is not later, or the first.
  function frameOf(motion) {
    const own = frames.filter((k) => scene.shapes[k].motion === motion), now = times[shown.frame] + 1e-6;
    return own.filter((k) => scene.shapes[k].time_s <= now).pop() ?? own[0];
  }
  const states = scene.shapes.map((s, k) => k).filter((k) => scene.shapes[k].time_s === null);
  const layers = scene.tissues.map(() => true);
  const opacity = { skin: 0.2, muscle: 1, bone: 1, other: 1 };
  const marksShown = {};
  const shown = { colour: "tissue", focus: null, frame: 0, playing: false };
  const up = new THREE_D.Vector3(...scene.up), towards = new THREE_D.Vector3(...scene.towards);
  const camera = new THREE_D.OrthographicCamera(-1, 1, 1, -1, 0.1, 10);
  camera.up.copy(up);
  const controls = new THREE_D.OrbitControls(camera, $("view"));
  controls.enableDamping = false;
  const plane = new THREE_D.Plane(new THREE_D.Vector3(1, 0, 0), 0);
  const all = new THREE_D.Box3(new THREE_D.Vector3(...scene.origin), new THREE_D.Vector3(...scene.origin.map((x, k) => x + scene.size[k])));
  const ball = all.getBoundingSphere(new THREE_D.Sphere());
  const sides = [];

  function makeSide() {
    const world = new THREE_D.Scene();
    world.add(new THREE_D.HemisphereLight(0xffffff, 0x8a8078, 1.6));
    const lamp = new THREE_D.DirectionalLight(0xffffff, 1.7);
    world.add(lamp, lamp.target);
    const side = { world, lamp, shape: -1, meshes: [], marks: new THREE_D.Group() };
    world.add(side.marks);
    return side;
  }

  function setShape(side, number) {
    if (side.shape === number) return;
    const shape = scene.shapes[number];
    const again = side.shape >= 0 && scene.shapes[side.shape].topology === shape.topology;
    if (!again) {
      side.meshes.forEach((mesh) => { side.world.remove(mesh); mesh.geometry.dispose(); mesh.material.dispose(); });
      side.meshes = topologies[shape.topology].map((part, t) => {
        const geometry = new THREE_D.BufferGeometry();
        geometry.setAttribute("position", new THREE_D.BufferAttribute(new Float32Array(3 * (part.v1 - part.v0)), 3));
        geometry.setIndex(new THREE_D.BufferAttribute(part.index, 1));
        const mesh = new THREE_D.Mesh(geometry, new THREE_D.MeshLambertMaterial({ side: THREE_D.DoubleSide }));
        mesh.userData.tissue = t;
        side.world.add(mesh);
        return mesh;
      });
    }
    side.shape = number;
    side.meshes.forEach((mesh, t) => {
      const part = topologies[shape.topology][t];
      const array = mesh.geometry.attributes.position.array;
      for (let i = 0; i < array.length; i++) array[i] = millimetres(whole[number][3 * part.v0 + i], i);
      mesh.geometry.attributes.position.needsUpdate = true;
      mesh.geometry.computeVertexNormals();
      mesh.geometry.computeBoundingSphere();
    });
    side.marks.clear();
    shape.marks.forEach((mark, m) => {
      const geometry = new THREE_D.BufferGeometry();
      geometry.setAttribute("position", new THREE_D.BufferAttribute(floats(bytes, mark.vertices), 3));
      const colour = MARK_COLOURS[mark.kind] || "#d900f2";
      let object;
      if (mark.faces[1]) {
        geometry.setIndex(new THREE_D.BufferAttribute(new Uint32Array(words(bytes, mark.faces)), 1));
        object = new THREE_D.Mesh(geometry, new THREE_D.MeshBasicMaterial({ color: colour, depthTest: false, transparent: true, opacity: 0.85, side: THREE_D.DoubleSide }));
      } else {
        object = new THREE_D.Points(geometry, new THREE_D.PointsMaterial({ color: colour, size: 5, sizeAttenuation: false, depthTest: false, transparent: true }));
      }
      object.renderOrder = 10;
      object.userData = { kind: mark.kind, mark: m };
      side.marks.add(object);
    });
    paint(side);
    look(side);
  }

  // Values to colour by, one for each vertex of a shape, with their range.
  function valuesOf(number) {
    const shape = scene.shapes[number];
    if (shown.colour === "displacement") return { name: "displacement", unit: "mm", low: 0, high: farthest(), ramp: SEQUENTIAL, at: displacements(number) };
    const field = shape.fields.find((f) => f.name === shown.colour);
    if (!field) return null;
    const steps = words(bytes, field.values);
    const at = Float32Array.from(steps, (s) => (s === 255 ? NaN : field.low + ((field.high - field.low) * s) / 254));
    const ramp = field.low < 1 && 1 < field.high && !field.unit ? DIVERGING : [...SEQUENTIAL].reverse();
    return { name: field.name, unit: field.unit, low: field.low, high: field.high, ramp, at };
  }

  const movedBy = new Map();
  function displacements(number) {
    if (movedBy.has(number)) return movedBy.get(number);
    const here = whole[number], rest = whole[0], shape = scene.shapes[number];
    const from = new Uint16Array(here.length);
    if (shape.topology === scene.shapes[0].topology) from.set(rest);
    else if (!isFirstOf(shape)) return new Float32Array(here.length / 3).fill(NaN);
    else firstOf(scene, shape, (i, j) => { from[i] = rest[j]; });
    const out = new Float32Array(here.length / 3);
    for (let v = 0; v < out.length; v++)
      out[v] = scene.quantum * Math.hypot(here[3 * v] - from[3 * v], here[3 * v + 1] - from[3 * v + 1], here[3 * v + 2] - from[3 * v + 2]);
    if (movedBy.size < 8) movedBy.set(number, out);
    return out;
  }

  let farthestKnown = 0;
  function farthest() {
    if (!farthestKnown) {
      const few = [...states, ...frames.filter((_, k) => k % Math.max(1, Math.floor(frames.length / 8)) === 0)];
      for (const k of few) for (const d of displacements(k)) if (d > farthestKnown) farthestKnown = d;
      farthestKnown = farthestKnown || 1;
    }
    return farthestKnown;
  }

  function onRamp(ramp, share) {
    const x = Math.min(Math.max(share, 0), 1) * (ramp.length - 1), k = Math.min(Math.floor(x), ramp.length - 2);
    return new THREE_D.Color(ramp[k]).lerp(new THREE_D.Color(ramp[k + 1]), x - k);
  }

  function paint(side) {
    const values = shown.colour === "tissue" ? null : valuesOf(side.shape);
    const table = values && Array.from({ length: 256 }, (_, k) => onRamp(values.ramp, k / 255));
    const none = new THREE_D.Color(NOT_A_NUMBER);
    side.meshes.forEach((mesh, t) => {
      const part = topologies[scene.shapes[side.shape].topology][t];
      if (values) {
        const colours = new Float32Array(3 * (part.v1 - part.v0));
        for (let v = part.v0; v < part.v1; v++) {
          const value = values.at[v];
          const c = Number.isNaN(value) ? none : table[Math.round(255 * Math.min(Math.max((value - values.low) / (values.high - values.low), 0), 1))];
          c.toArray(colours, 3 * (v - part.v0));
        }
        mesh.geometry.setAttribute("color", new THREE_D.BufferAttribute(colours, 3));
      } else mesh.geometry.deleteAttribute("color");
      mesh.material.vertexColors = Boolean(values);
      mesh.material.color.set(values ? "#ffffff" : scene.tissues[t].colour);
      mesh.material.needsUpdate = true;
    });
    return values;
  }

  // Who is seen, how opaque, and what is pointed out.
  function look(side) {
    const cut = $("section-on").checked ? [plane] : [];
    side.meshes.forEach((mesh, t) => {
      const far = shown.focus && !shown.focus.includes(scene.tissues[t].name);
      const dense = far ? Math.min(0.08, opacity[scene.tissues[t].kind] ?? 1) : opacity[scene.tissues[t].kind] ?? 1;
      mesh.visible = (layers[t] || Boolean(shown.focus && !far)) && dense > 0;
      mesh.material.opacity = dense;
      mesh.material.transparent = dense < 1;
      mesh.material.depthWrite = dense >= 1;
      mesh.renderOrder = dense < 1 ? 5 : 0;
      mesh.material.clippingPlanes = cut;
      mesh.material.needsUpdate = true;
    });
    for (const object of side.marks.children) object.visible = marksShown[object.userData.kind] !== false;
  }

  // ---- drawing ----------------------------------------------------------------------------------------------------

  let asked = false;
  function draw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => { asked = false; drawNow(); });
  }

  function drawNow() {
    const canvas = $("view"), width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    const size = renderer.getSize(new THREE_D.Vector2());
    if (size.x !== width || size.y !== height) renderer.setSize(width, height, false);
    const each = width / sides.length, aspect = each / height;
    const half = ball.radius * 1.03 * Math.max(1, 1 / aspect);
    camera.top = half; camera.bottom = -half; camera.right = half * aspect; camera.left = -half * aspect;
    camera.near = -20 * ball.radius; camera.far = 20 * ball.radius;
    camera.updateProjectionMatrix();
    renderer.setScissorTest(true);
    sides.forEach((side, k) => {
      side.lamp.position.copy(camera.position);
      side.lamp.target.position.copy(controls.target);
      renderer.setViewport(k * each, 0, each, height);
      renderer.setScissor(k * each, 0, each, height);
      renderer.clear();
      renderer.render(side.world, camera);
    });
    if (!root.dataset.firstFrameMs) root.dataset.firstFrameMs = String(Math.round(performance.now() - began));
    root.dataset.drawn = String(Number(root.dataset.drawn || 0) + 1);
    document.documentElement.dataset.viewer = "ready";
  }

  function home() {
    controls.target.copy(ball.center);
    camera.position.copy(ball.center).addScaledVector(towards, 4 * ball.radius);
    camera.zoom = 1;
    fitted();
    controls.update();
    draw();
  }

  // Zoom so that the box of all shapes, as it is seen from here, fills the view.
  function fitted() {
    const right = new THREE_D.Vector3().crossVectors(up, towards);
    let tall = 0, wide = 0;
    for (let k = 0; k < 8; k++) {
      const corner = new THREE_D.Vector3(k & 1 ? all.max.x : all.min.x, k & 2 ? all.max.y : all.min.y, k & 4 ? all.max.z : all.min.z).sub(ball.center);
      tall = Math.max(tall, Math.abs(corner.dot(up)));
      wide = Math.max(wide, Math.abs(corner.dot(right)));
    }
    const canvas = $("view"), aspect = canvas.clientWidth / sides.length / canvas.clientHeight || 1;
    const half = ball.radius * 1.03 * Math.max(1, 1 / aspect);
    camera.zoom = half / (1.05 * Math.max(tall, wide / aspect));
  }

  function flyTo(box) {
    const goal = box.getBoundingSphere(new THREE_D.Sphere());
    const zoom = Math.min(60, Math.max(0.8, (0.55 * ball.radius) / Math.max(goal.radius, ball.radius / 80)));
    const from = controls.target.clone(), zoom0 = camera.zoom, start = performance.now(), lasts = reduced ? 1 : 450;
    const step = () => {
      const t = Math.min(1, (performance.now() - start) / lasts), s = t * t * (3 - 2 * t);
      const target = from.clone().lerp(goal.center, s);
      camera.position.add(target.clone().sub(controls.target));
      controls.target.copy(target);
      camera.zoom = zoom0 * (zoom / zoom0) ** s;
      camera.lookAt(target);
      drawNow();
      if (t < 1) requestAnimationFrame(step);
      else { controls.update(); root.dataset.at = goal.center.toArray().map((x) => x.toFixed(2)).join(" "); }
    };
    step();
  }

  function say(text) {
    $("view-said").textContent = text;
  }

  function focusOn(names, box, text) {
    shown.focus = names;
    $("show-all").hidden = false;
    sides.forEach(look);
    root.scrollIntoView({ behavior: "auto", block: "start" });
    flyTo(box);
    say(text);
  }

  function boxOf(names) {
    const box = new THREE_D.Box3(), side = sides[sides.length - 1];
    side.meshes.forEach((mesh, t) => {
      if (names.includes(scene.tissues[t].name)) { mesh.geometry.computeBoundingBox(); box.union(mesh.geometry.boundingBox); }
    });
    return box;
  }

  // ---- controls ---------------------------------------------------------------------------------------------------

  function option(select, value, text) {
    const made = document.createElement("option");
    made.value = value;
    made.textContent = text;
    select.append(made);
  }

  function labelled(type, text, parent) {
    const label = document.createElement("label"), input = document.createElement("input");
    input.type = type;
    label.append(input, document.createTextNode(` ${text}`));
    parent.append(label);
    return input;
  }

  const left = $("left"), right = $("right");
  option(left, "none", "nothing (one view)");
  for (const k of states) { option(left, k, scene.shapes[k].title); option(right, k, scene.shapes[k].title); }
  for (const [m, name] of motions.entries()) { option(left, `motion ${m}`, name || "Motion"); option(right, `motion ${m}`, name || "Motion"); }
  const narrow = matchMedia("(max-width: 48rem)").matches;
  left.value = narrow || states.length < 1 || scene.shapes.length < 2 ? "none" : motions.length > 1 ? "motion 0" : "0";
  right.value = frames.length ? `motion ${Math.min(1, motions.length - 1)}` : String(states[Math.min(1, states.length - 1)]);

  function choose() {
    const wanted = [left.value, right.value].filter((v) => v !== "none").map((v) => (v.startsWith("motion") ? frameOf(motions[Number(v.slice(7))]) : Number(v)));
    while (sides.length < wanted.length) sides.push(makeSide());
    while (sides.length > wanted.length) sides.shift();
    wanted.forEach((number, k) => setShape(sides[k], number));
    const titles = wanted.map((number) => [scene.shapes[number].motion, scene.shapes[number].title].filter(Boolean).join(": "));
    $("title-left").textContent = titles.length > 1 ? titles[0] : "";
    $("title-right").textContent = titles[titles.length - 1];
    root.dataset.shown = titles.join(" | ");
    $("view").setAttribute("aria-label", `3-D view of ${titles.join(" beside ")}. Arrow keys turn it, plus and minus zoom, 0 brings it back.`);
    scale();
    draw();
  }
  // What stood beside each other before a place was shown, which is one state's alone.
  let before = null;
  function showAlone(number) {
    before ??= [left.value, right.value];
    left.value = "none";
    right.value = String(number);
    choose();
  }
  function showAsBefore() {
    if (before) { [left.value, right.value] = before; before = null; choose(); }
  }
  for (const select of [left, right]) select.addEventListener("change", () => { before = null; choose(); say(`Shown: ${root.dataset.shown}`); });

  const colour = $("colour");
  option(colour, "tissue", "tissue");
  option(colour, "displacement", "displacement");
  for (const name of new Set(scene.shapes.flatMap((s) => s.fields.map((f) => f.name)))) option(colour, name, name === "gap" ? "gap to the next tissue" : name);
  function scale() {
    const of = shown.colour === "tissue" ? null : sides.map((s) => valuesOf(s.shape)).find(Boolean);
    $("scale").hidden = !of;
    if (!of) return;
    $("scale-bar").style.background = `linear-gradient(to right, ${of.ramp.join(", ")})`;
    $("scale-low").textContent = `${of.low.toPrecision(3)}`;
    $("scale-name").textContent = `${of.name}${of.unit ? ", " + of.unit : ""}${{ gap: " (between vertices; grey: farther, or skin)", "stretch along muscles": " (white: as at rest)", "det J": " (white: as at rest)" }[of.name] ?? ""}`;
    $("scale-high").textContent = `${of.high.toPrecision(3)}`;
  }
  colour.addEventListener("change", () => { shown.colour = colour.value; sides.forEach(paint); scale(); draw(); say(`Coloured by ${colour.selectedOptions[0].textContent}`); });

  // The first section faces the reader.
  $("section-axis").value = String([0, 1, 2].reduce((a, b) => (Math.abs(towards.getComponent(b)) > Math.abs(towards.getComponent(a)) ? b : a)));
  $("section-flip").checked = towards.getComponent(Number($("section-axis").value)) < 0;

  // Through the middle of what is shown, until it is moved by hand.
  let placed = false;
  $("section-at").addEventListener("input", () => { placed = true; });
  function halve() {
    if (placed || !$("section-on").checked) return;
    const axis = Number($("section-axis").value), low = all.min.getComponent(axis), size = all.max.getComponent(axis) - low;
    const box = boxOf(scene.tissues.map((t) => t.name));
    if (size > 0 && !box.isEmpty()) $("section-at").value = String(Math.round((100 * (box.min.getComponent(axis) + box.max.getComponent(axis) - 2 * low)) / size) / 2);
  }

  function section() {
    halve();
    const axis = Number($("section-axis").value), sign = $("section-flip").checked ? -1 : 1;
    const share = Number($("section-at").value) / 100;
    const place = all.min.getComponent(axis) + share * (all.max.getComponent(axis) - all.min.getComponent(axis));
    plane.normal.set(0, 0, 0).setComponent(axis, -sign);
    plane.constant = sign * place;
    $("section-said").textContent = `${place.toFixed(1)} mm`;
    sides.forEach(look);
    draw();
  }
  for (const id of ["section-on", "section-axis", "section-at", "section-flip"]) $(id).addEventListener("input", section);
  for (const select of [left, right]) select.addEventListener("change", section);

  const kinds = [...new Set(scene.tissues.map((t) => t.kind))];
  const boxes = [];
  for (const kind of kinds) {
    const group = document.createElement("fieldset"), legend = document.createElement("legend");
    const count = scene.tissues.filter((t) => t.kind === kind).length;
    const every = labelled("checkbox", `${kind} (${count})`, legend);
    every.checked = true;
    every.dataset.kind = kind;
    group.append(legend);
    const dense = labelled("range", "opacity", group);
    Object.assign(dense, { min: 0, max: 100, value: 100 * (opacity[kind] ?? 1) });
    dense.setAttribute("aria-label", `Opacity of ${kind}`);
    dense.addEventListener("input", () => { opacity[kind] = Number(dense.value) / 100; sides.forEach(look); draw(); });
    const list = document.createElement("div");
    list.className = "names";
    scene.tissues.forEach((tissue, t) => {
      if (tissue.kind !== kind) return;
      const box = labelled("checkbox", tissue.name, list);
      box.checked = true;
      boxes[t] = box;
      box.addEventListener("change", () => { layers[t] = box.checked; sides.forEach(look); draw(); });
    });
    every.addEventListener("change", () => {
      scene.tissues.forEach((tissue, t) => { if (tissue.kind === kind) { layers[t] = boxes[t].checked = every.checked; } });
      sides.forEach(look);
      draw();
    });
    group.append(list);
    $("layers").append(group);
  }
  $("layer-filter").addEventListener("input", () => {
    const sought = $("layer-filter").value.trim().toLowerCase();
    boxes.forEach((box, t) => { box.parentElement.hidden = !scene.tissues[t].name.toLowerCase().includes(sought); });
  });

  const markKinds = [...new Set(scene.shapes.flatMap((s) => s.marks.map((m) => m.kind)))];
  $("marks").hidden = !markKinds.length;
  for (const kind of markKinds) {
    const box = labelled("checkbox", { fold: "folded places", overlap: "overlaps", "inverted tet": "inverted tetrahedra", "contact zone": "contact zones (at rest)" }[kind] || kind, $("marks"));
    box.checked = kind !== "contact zone";
    marksShown[kind] = box.checked;
    box.parentElement.style.setProperty("--mark", MARK_COLOURS[kind]);
    box.addEventListener("change", () => { marksShown[kind] = box.checked; sides.forEach(look); draw(); });
  }

  // ---- motion -----------------------------------------------------------------------------------------------------

  $("motion").hidden = !frames.length;
  if (frames.length) {
    const slider = $("time"), play = $("play");
    slider.max = String(times.length - 1);
    const go = (k) => {
      shown.frame = k;
      slider.value = String(k);
      const text = `${times[k].toFixed(3)} s, frame ${k + 1} of ${times.length}`;
      slider.setAttribute("aria-valuetext", text);
      $("time-said").textContent = text;
      choose();
    };
    slider.addEventListener("input", () => go(Number(slider.value)));
    let last = 0;
    const tick = (now) => {
      if (!shown.playing) return;
      if (now - last > 80) { last = now; go((shown.frame + 1) % times.length); }
      requestAnimationFrame(tick);
    };
    play.addEventListener("click", () => {
      shown.playing = !shown.playing;
      play.textContent = shown.playing ? "Pause" : "Play";
      play.setAttribute("aria-pressed", String(shown.playing));
      if (shown.playing) requestAnimationFrame(tick);
    });
    const first = times.findIndex((time) => Math.abs(time - scene.first_time_s) < 1e-6);
    go(scene.first_time_s === null ? 0 : Math.max(0, first));
  } else choose();

  // ---- tables, mouse and keys -------------------------------------------------------------------------------------

  function button(row, label, act) {
    const cell = row.querySelector("td.name") || row.cells[0];
    const made = document.createElement("button");
    made.type = "button";
    made.className = "fly";
    made.textContent = "◎ show";
    made.setAttribute("aria-label", `Show in 3-D: ${label}`);
    made.addEventListener("click", act);
    cell.append(" ", made);
  }
  const stateNamed = (title) => states.find((k) => scene.shapes[k].title === title);
  for (const row of document.querySelectorAll("tr[data-tissue]")) {
    const names = [row.dataset.tissue, row.dataset.with].filter(Boolean);
    if (!names.every((name) => scene.tissues.some((t) => t.name === name))) continue;
    button(row, names.join(" and "), () => { showAsBefore(); focusOn(names, boxOf(names), `Shown: ${names.join(" and ")}`); });
  }
  for (const row of document.querySelectorAll("tr[data-mark]")) {
    const [s, m] = row.dataset.mark.split(" ").map(Number);
    const mark = scene.shapes[s].marks[m];
    button(row, `${mark.kind}, ${mark.tissues.join(" and ")}, ${scene.shapes[s].title}`, () => {
      showAlone(s); // elsewhere in space, another state shows another place
      marksShown[mark.kind] = true;
      const box = new THREE_D.Box3().setFromArray(floats(bytes, mark.vertices));
      focusOn(mark.tissues, box, `${mark.kind}: ${mark.tissues.join(" and ")}, ${mark.title}`);
    });
  }
  for (const row of document.querySelectorAll("tr[data-at]")) {
    const at = new THREE_D.Vector3(...row.dataset.at.split(" ").map(Number));
    button(row, `place ${row.dataset.at}`, () => {
      if (stateNamed("Result") !== undefined) showAlone(stateNamed("Result"));
      focusOn([row.dataset.near], new THREE_D.Box3().setFromCenterAndSize(at, new THREE_D.Vector3(1, 1, 1).multiplyScalar(ball.radius / 20)), `Place ${row.dataset.at} mm in ${row.dataset.near}`);
    });
  }
  $("show-all").addEventListener("click", () => { shown.focus = null; $("show-all").hidden = true; showAsBefore(); sides.forEach(look); home(); say("All is shown again"); });

  const canvas = $("view");
  let pressed = null;
  canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointerup", (event) => {
    if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 4) return;
    const frame = canvas.getBoundingClientRect(), each = frame.width / sides.length;
    const k = Math.min(sides.length - 1, Math.floor((event.clientX - frame.left) / each));
    const ray = new THREE_D.Raycaster();
    const at = new THREE_D.Vector2(((event.clientX - frame.left - k * each) / each) * 2 - 1, 1 - ((event.clientY - frame.top) / frame.height) * 2);
    ray.setFromCamera(at, camera);
    ray.ray.origin.addScaledVector(ray.ray.direction, -20 * ball.radius);
    const cut = $("section-on").checked;
    const hits = ray.intersectObjects(sides[k].meshes.filter((m) => m.visible && m.material.opacity >= 0.5), false)
      .filter((h) => !cut || plane.distanceToPoint(h.point) >= 0);
    $("picked").hidden = !hits.length;
    if (!hits.length) return;
    const t = hits[0].object.userData.tissue, tissue = scene.tissues[t];
    const values = shown.colour === "tissue" ? null : valuesOf(sides[k].shape);
    const value = values ? values.at[topologies[scene.shapes[sides[k].shape].topology][t].v0 + hits[0].face.a] : NaN;
    const text = `${tissue.name} (${tissue.kind})${Number.isNaN(value) ? "" : `, ${values.name} ${value.toPrecision(3)} ${values.unit}`}`;
    $("picked").textContent = text;
    say(text);
  });
  function turn(horizontal, vertical) {
    const arm = camera.position.clone().sub(controls.target);
    arm.applyAxisAngle(up, horizontal);
    const sideways = new THREE_D.Vector3().crossVectors(arm, up).normalize();
    const turned = arm.clone().applyAxisAngle(sideways, vertical);
    if (Math.abs(turned.clone().normalize().dot(up)) < 0.995) arm.copy(turned);
    camera.position.copy(controls.target).add(arm);
    controls.update();
    draw();
  }
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const acts = {
      ArrowLeft: () => turn(-0.15, 0), ArrowRight: () => turn(0.15, 0), ArrowUp: () => turn(0, -0.15), ArrowDown: () => turn(0, 0.15),
      "+": () => { camera.zoom *= 1.2; draw(); }, "=": () => { camera.zoom *= 1.2; draw(); }, "-": () => { camera.zoom /= 1.2; draw(); },
      0: () => home(), s: () => $("section-on").click(), " ": () => frames.length && $("play").click(),
    };
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
    root.dataset.camera = camera.position.toArray().map((x) => x.toFixed(2)).join(" ") + ` ${camera.zoom.toFixed(3)}`;
  });
  $("home").addEventListener("click", home);
  $("save-picture").addEventListener("click", () => {
    drawNow();
    const link = document.createElement("a");
    link.href = canvas.toDataURL("image/png");
    link.download = "view.png";
    link.click();
  });
  controls.addEventListener("change", draw);
  new ResizeObserver(() => draw()).observe(canvas);
  section();
  home();
})();
