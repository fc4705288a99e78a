/* Draws the figure: one panel below another, each with its title and legend as text, its axes as an
   SVG, and its curves on a canvas above them. Nothing here knows what is drawn: cosim/lab/page_parts.py
   describes panels, axes and items, and sends all numbers as one array.

   While a slider is dragged, only the canvases change. They are drawn by the processor: a browser
   without a graphics card emulates one, which takes ten times as long for the same curves. */

const SVG = 'http://www.w3.org/2000/svg';
const LEFT = 62, RIGHT = 10, TOP = 6, BOTTOM = 8, NUMBERS = 42;

function labNode(tag, attributes, ...children) {
  const svg = ['svg', 'g', 'path', 'line', 'text', 'circle'].includes(tag);
  const node = svg ? document.createElementNS(SVG, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

class LabPanel {
  constructor(place) {
    this.title = labNode('h2', {});
    this.legend = labNode('ul', {});
    this.axes = labNode('g', {class: 'lab-axes'});
    this.canvas = labNode('canvas', {});
    this.pen = this.canvas.getContext('2d', {willReadFrequently: true});
    this.pointer = labNode('path', {class: 'lab-pointer'});
    this.svg = labNode('svg', {'aria-hidden': 'true'}, this.axes, this.pointer);
    this.box = labNode('div', {class: 'lab-plot'}, this.svg, this.canvas);
    this.head = labNode('div', {class: 'lab-panel-head'}, this.title, this.legend);
    this.whole = labNode('section', {class: 'lab-panel'}, this.head, this.box);
    place.append(this.whole);
  }

  show(panel, columns) {
    this.panel = panel;
    this.columns = columns;
    this.draw();
    this.whole.style.flexGrow = panel.height;
    if (this.title.textContent !== panel.title) this.title.textContent = panel.title;
    const legend = JSON.stringify(panel.legend);
    if (legend === this.legendText) return;
    this.legendText = legend;
    this.values = panel.legend.map(() => labNode('output', {}));
    this.legend.replaceChildren(...panel.legend.map((item, i) => labNode(
      'li', {}, labSwatch(item), item.label, this.values[i])));
  }

  draw() {
    const {panel} = this;
    if (!panel || !this.width) return;
    const bottom = panel.numbers ? NUMBERS : BOTTOM;
    const width = Math.max(this.width - LEFT - RIGHT, 10);
    const height = Math.max(this.height - TOP - bottom, 10);
    const scale = panel.log ? Math.log10 : (value => value);
    const low = scale(panel.low), high = scale(panel.high);
    this.x = t => (t - panel.start) / (panel.end - panel.start) * width;
    this.y = v => height * (1 - (scale(v) - low) / (high - low));
    const axes = JSON.stringify([width, height, panel.low, panel.high, panel.start, panel.end,
      panel.log, panel.numbers, panel.label]);
    if (axes !== this.axesText) {
      this.axesText = axes;
      this.inner = {width, height};
      this.scale = window.devicePixelRatio || 1;
      Object.assign(this.canvas.style, {left: `${LEFT}px`, top: `${TOP}px`,
        width: `${width}px`, height: `${height}px`});
      this.canvas.width = Math.round(width * this.scale);
      this.canvas.height = Math.round(height * this.scale);
      this.drawAxes(width, height);
    }
    this.drawItems();
  }

  drawItems() {
    const {pen, inner} = this;
    pen.setTransform(this.scale, 0, 0, this.scale, 0, 0);
    pen.clearRect(0, 0, inner.width, inner.height);
    for (const item of this.panel.items) {
      labStyle(pen, item);
      pen.beginPath();
      if (item.kind === 'line') this.trace(item.x, item.y, 1);
      else if (item.kind === 'band') {
        this.trace(item.x, item.y, 1);
        this.trace(item.x, item.high, -1);
      } else this.mark(item);
      if (item.kind === 'band') pen.fill(); else pen.stroke();
    }
  }

  /* Trace a curve, forward or backward; a gap in the values is a gap in a curve. */
  trace(x, y, step) {
    const t = this.columns[x], values = this.columns[y], {pen} = this;
    let drawing = step < 0;
    for (let k = 0; k < t.length; k++) {
      const i = step > 0 ? k : t.length - 1 - k;
      const height = Math.min(Math.max(this.y(values[i]), -999), 9999);
      if (Number.isNaN(height)) drawing = false;
      else if (drawing) pen.lineTo(this.x(t[i]), height);
      else {
        pen.moveTo(this.x(t[i]), height);
        drawing = true;
      }
    }
  }

  mark(item) {
    const t = this.columns[item.x], values = this.columns[item.y], {pen} = this;
    for (let i = 0; i < t.length; i++) {
      const x = this.x(t[i]), y = this.y(values[i]);
      pen.moveTo(x - 4, y - 4);
      if (item.kind === 'cross') {
        pen.lineTo(x + 4, y + 4);
        pen.moveTo(x + 4, y - 4);
        pen.lineTo(x - 4, y + 4);
      } else {
        pen.moveTo(x, y);
        pen.lineTo(x, y);
      }
    }
  }

  drawAxes(width, height) {
    const {panel} = this, grid = [], texts = [];
    for (const value of labTicks(panel.low, panel.high, panel.log, height / 26)) {
      const y = (TOP + this.y(value)).toFixed(1);
      grid.push(`M${LEFT} ${y}h${width}`);
      texts.push(labNode('text', {x: LEFT - 6, y: +y + 4.5, 'text-anchor': 'end'},
        labNumber(value)));
    }
    for (const value of labTicks(panel.start, panel.end, false, width / 60)) {
      const x = (LEFT + this.x(value)).toFixed(1);
      grid.push(`M${x} ${TOP}v${height}`);
      if (!panel.numbers) continue;
      const anchor = x > LEFT + width - 12 ? 'end' : 'middle';
      texts.push(labNode('text', {x, y: TOP + height + 17, 'text-anchor': anchor},
        labNumber(value)));
    }
    if (panel.numbers) {
      texts.push(labNode('text', {x: LEFT + width / 2, y: TOP + height + 35,
        'text-anchor': 'middle'}, panel.label));
    }
    this.axes.replaceChildren(labNode('path', {d: grid.join('')}),
      labNode('path', {d: `M${LEFT} ${TOP}v${height}h${width}`, class: 'lab-frame'}), ...texts);
  }

  /* Show the values at a time in the legend, or none. */
  point(t) {
    const out = t === null || !(t >= this.panel.start && t <= this.panel.end);
    this.pointer.setAttribute('d', out ? '' :
      `M${(LEFT + this.x(t)).toFixed(1)} ${TOP}v${this.inner.height}`);
    this.panel.legend.forEach((entry, i) => {
      const item = this.panel.items.find(other => other.kind === 'line' && other.label === entry.label);
      const value = out || !item ? NaN
        : this.columns[item.y][labIndex(this.columns[item.x], t)];
      this.values[i].textContent = Number.isFinite(value) ? ` ${+value.toPrecision(3)}` : '';
    });
  }
}

function labStyle(pen, item) {
  const dots = item.kind === 'dot';
  pen.strokeStyle = pen.fillStyle = item.colour;
  pen.globalAlpha = item.opacity;
  pen.lineWidth = dots ? 8 : item.width;
  pen.lineCap = dots ? 'round' : 'butt';
  pen.lineJoin = 'round';
  pen.setLineDash(item.dash.map(length => length * item.width));
}

function labSwatch(item) {
  const swatch = labNode('canvas', {width: 44, height: 28, 'aria-hidden': 'true'});
  const pen = swatch.getContext('2d', {willReadFrequently: true});
  const outline = {line: 'M0 7h22', band: 'M0 1h22v12h-22z', dot: 'M11 7h.01',
    cross: 'M7 3l8 8m0 -8l-8 8'};
  pen.scale(2, 2);
  labStyle(pen, item);
  const path = new Path2D(outline[item.kind]);
  if (item.kind === 'band') pen.fill(path); else pen.stroke(path);
  return swatch;
}

/* Return round numbers between two ends: at most about ``most``. */
function labTicks(low, high, log, most) {
  const ticks = [];
  if (log && high / low > 20) {
    const first = Math.ceil(Math.log10(low)), last = Math.floor(Math.log10(high));
    const step = Math.max(1, Math.ceil((last - first + 1) / Math.max(most, 2)));
    for (let i = Math.ceil(first / step) * step; i <= last; i += step) ticks.push(10 ** i);
    return ticks;
  }
  const rough = (high - low) / Math.max(Math.min(most, 10), 2);
  const decade = 10 ** Math.floor(Math.log10(rough));
  const step = decade * [1, 2, 5, 10].find(factor => factor * decade >= rough * 0.999);
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high * (1 + 1e-9); i++) {
    ticks.push(+(i * step).toPrecision(9));
  }
  return ticks;
}

function labNumber(value) {
  if (value === 0 || (Math.abs(value) >= 1e-3 && Math.abs(value) < 1e5)) {
    return String(+value.toPrecision(6)).replace('-', '−');
  }
  const [digits, power] = value.toExponential().split('e');
  const raised = [...String(+power)].map(digit => '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'['-0123456789'.indexOf(digit)]).join('');
  return (digits === '1' ? '' : `${+(+digits).toPrecision(3)}·`) + `10${raised}`;
}

/* Return the index of the last time that is not later. */
function labIndex(times, t) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle + 1; else high = middle;
  }
  return Math.max(low - 1, 0);
}

class LabFigure {
  constructor(place) {
    this.place = place;
    this.panels = [];
    this.sizes = new ResizeObserver(entries => {
      for (const entry of entries) {
        const panel = this.panels.find(shown => shown.box === entry.target);
        if (!panel) continue;
        ({width: panel.width, height: panel.height} = entry.contentRect);
        requestAnimationFrame(() => panel.draw());
      }
    });
    place.addEventListener('pointermove', event => this.point(event));
    place.addEventListener('pointerleave', () => this.panels.forEach(panel => panel.point(null)));
  }

  show({panels, lengths, numbers, description}) {
    const text = atob(numbers), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const columns = [];
    let begin = 0;
    for (const length of lengths) {
      columns.push(new Float32Array(bytes.buffer, 4 * begin, length));
      begin += length;
    }
    while (this.panels.length < panels.length) {
      this.panels.push(new LabPanel(this.place));
      this.sizes.observe(this.panels.at(-1).box);
    }
    panels.forEach((panel, i) => this.panels[i].show(panel, columns));
    if (this.place.ariaLabel !== description) this.place.ariaLabel = description;
  }

  point(event) {
    const first = this.panels.find(panel => panel.width);
    if (!first) return;
    const x = event.clientX - first.box.getBoundingClientRect().left - LEFT;
    const {start, end} = first.panel, width = first.width - LEFT - RIGHT;
    this.panels.forEach(panel => panel.point(start + (end - start) * x / width));
  }
}
