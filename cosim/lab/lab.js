/* What the page does in the browser itself: it shows the parts that the server sends (labShow), and
   reports what a visitor does (labSend). Drawer, sliders and tutorial are plain elements, so that a
   dragged slider changes nothing else. */

const LAB = {narrow: matchMedia('(max-width: 800px)')};

function labSend(what, fields) {
  emitEvent('lab', {what, ...fields});
}

function labById(name) {
  return document.getElementById(`lab-${name}`);
}

/* Show new parts of the page; return once the browser has drawn them, so that a slow one is not
   sent more than it draws. */
function labShow(parts) {
  for (const [name, content] of Object.entries(parts)) LAB_PARTS[name](content);
  return new Promise(done => {
    if (document.hidden) done(true);
    else requestAnimationFrame(() => done(true));
  });
}

const LAB_PARTS = {
  figure(content) {
    LAB.figure ??= new LabFigure(labById('figure'));
    LAB.figure.show(content);
  },
  source(name) { document.body.dataset.labSource = name; },
  stale(yes) { labById('stage').classList.toggle('lab-stale', yes); },
  note(text) { labText('note', text); },
  pending(text) { labText('pending', text); },
  progress(share) {
    labById('progress').hidden = share === null;
    labById('progress').value = share ?? 0;
  },
  report(address) {
    labById('report').hidden = !address;
    labById('report').href = address;
  },
  verdict(lines) {
    labEach(labById('verdict'), lines, () => labNode('p', {}), (line, [text, tone]) => {
      line.className = `lab-${tone}`;
      if (line.textContent !== text) line.textContent = text;
    });
  },
  compare(content) {
    const place = labById('compare');
    place.hidden = !content;
    if (!content) return;
    const {title, settings, rows} = content;
    const all = [['', 'dashed', 'now', 'difference'], ...rows];
    if (!place.firstChild) {
      place.append(labNode('h2', {}), labNode('p', {}), labNode('table', {}));
    }
    labEach(place, [title, settings], null, labSet);
    labEach(place.lastChild, all, () => labNode('tr', {}), (row, cells, i) => labEach(row, cells,
      j => labNode(i && j ? 'td' : 'th', {scope: i ? 'row' : 'col'}), labSet));
  },
  slider([key, text]) {
    const input = document.getElementById(`lab-set-${key}`);
    if (input) labSet(input.previousSibling, input.ariaValueText = text);
  },
  facts(groups) {
    labById('facts').replaceChildren(...groups.flatMap(([heading, rows]) => [
      labNode('h2', {}, heading),
      labNode('dl', {}, ...rows.flatMap(([name, value]) =>
        [labNode('dt', {}, name), labNode('dd', {}, value)])),
    ]));
  },
  states({names, chosen}) {
    const select = labById('state');
    select.parentElement.hidden = names.length < 2;
    labFill(select, names.map((name, i) => [String(i), name]), String(chosen));
  },
  controls(content) { labShowControls(content); },
  query(text) {  // the browser limits how often the address may change
    clearTimeout(LAB.query);
    LAB.query = setTimeout(() => history.replaceState(null, '', text), 300);
  },
  steps(steps) {
    LAB.steps = steps;
    labGoTo(0, false);
  },
};

function labSet(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function labText(name, text) {
  const place = labById(name);
  place.hidden = !text;
  labSet(place, text);
}

/* Show contents in the children of a place, of which there are as many if they can be made. */
function labEach(place, contents, make, show) {
  while (make && place.childElementCount < contents.length) {
    place.append(make(place.childElementCount));
  }
  while (make && place.childElementCount > contents.length) place.lastChild.remove();
  contents.forEach((content, i) => show(place.children[i], content, i));
}

function labFill(select, options, chosen) {
  const text = JSON.stringify(options);
  if (select.labOptions !== text) {
    select.labOptions = text;
    select.replaceChildren(...options.map(([value, name]) => labNode('option', {value}, name)));
  }
  if (select.value !== chosen) select.value = chosen;
}

/* Choices and sliders. A slider that is being moved keeps its position: what arrives is older. */
function labShowControls({choices, sliders}) {
  const place = labById('controls');
  const shape = JSON.stringify([...choices, ...sliders].map(control => control.key));
  if (LAB.shape !== shape) {
    LAB.shape = shape;
    place.replaceChildren(...choices.map(labChoice), ...sliders.map(labSlider));
  }
  choices.forEach((choice, i) =>
    labFill(place.children[i].lastChild, choice.options, choice.value));
  sliders.forEach((slider, i) => {
    const row = place.children[choices.length + i], [label, value, input] = row.children;
    const moving = performance.now() - (input.labMoved ?? -1e9) < 400;
    labSet(label, slider.label);
    labSet(value, input.ariaValueText = slider.text);
    for (const name of ['min', 'max', 'step']) {
      if (input[name] !== String(slider[name])) input[name] = slider[name];
    }
    if (!moving) input.value = slider.position;
    row.classList.toggle('lab-wrong', slider.wrong);
  });
}

function labChoice(choice) {
  const select = labNode('select', {id: `lab-set-${choice.key}`});
  select.addEventListener('change', () => labSend('choose', {key: choice.key, value: select.value}));
  return labNode('div', {class: 'lab-choice'},
    labNode('label', {for: select.id}, choice.label), select);
}

function labSlider(slider) {
  const input = labNode('input', {type: 'range', id: `lab-set-${slider.key}`});
  input.addEventListener('input', () => {
    input.labMoved = performance.now();
    labSend('slide', {key: slider.key, position: input.valueAsNumber});
  });
  return labNode('div', {class: 'lab-slider'},
    labNode('label', {for: input.id}), labNode('output', {for: input.id}), input);
}

/* Open or close the drawer; whether it is open is remembered. */
function labDrawer(open, remember = true) {
  const drawer = labById('drawer'), button = document.querySelector('.lab-drawer-button');
  document.body.classList.toggle('lab-open', open);
  drawer.inert = !open;
  button.ariaExpanded = String(open);
  if (remember) localStorage.setItem('lab-drawer', open ? 'open' : 'closed');
}

function labToggleDrawer() {
  labDrawer(!document.body.classList.contains('lab-open'));
}

/* The tutorial is a guide at the top of the drawer, above the sliders that it asks to drag. */
function labToggleGuide() {
  const guide = labById('guide'), button = document.querySelector('.lab-guide-button');
  guide.hidden = !guide.hidden;
  button.ariaExpanded = String(!guide.hidden);
  if (guide.hidden) return;
  labDrawer(true);
  labById('drawer').scrollTop = 0;
  labGoTo(LAB.step, true);
  labById('guide').querySelector('button').focus();
}

function labGoTo(step, begin) {
  const button = (text, to) => {
    const node = labNode('button', {type: 'button'}, text);
    node.disabled = !LAB.steps[to];
    node.addEventListener('click', () => labGoTo(to, true));
    return node;
  };
  const {title, text, drag} = LAB.steps[LAB.step = step];
  const next = button('next', step + 1), back = button('back', step - 1);
  const again = button('begin this step again', step);
  const focused = document.activeElement?.textContent;
  labById('guide').replaceChildren(
    labNode('h2', {}, `${step + 1} of ${LAB.steps.length}: ${title}`), labNode('p', {}, text),
    labNode('p', {class: 'lab-drag'}, drag), labNode('div', {}, next, back, again));
  [next, back, again].find(node => node.textContent === focused && !node.disabled)?.focus();
  if (begin) labSend('step', {number: step});
}

/* Name the editor, which cannot be named from the server. */
function labNameEditor() {
  for (const text of document.querySelectorAll('.cm-content')) text.ariaLabel = 'scenario as TOML';
  for (const area of document.querySelectorAll('.cm-scroller')) area.tabIndex = 0;
}

/* Begin: called once the page is connected. */
function labBegin() {
  const lost = document.getElementById('popup');  // shown after 2 s without a connection
  lost.role = 'alert';
  lost.children[0].textContent = 'The page has lost its server.';
  lost.children[1].textContent = 'Has noack lab ended? Start it again and open the address that it '
    + 'shows. The settings are in the address of this page, after the "?".';
  const remembered = localStorage.getItem('lab-drawer');
  labDrawer(remembered ? remembered === 'open' : !LAB.narrow.matches, false);
  labById('state').addEventListener('change', event =>
    labSend('state', {number: Number(event.target.value)}));
  document.addEventListener('keydown', event => {
    const inside = labById('drawer').contains(document.activeElement);
    if (event.key !== 'Escape' || !inside) return;
    labDrawer(false);
    document.querySelector('.lab-drawer-button').focus();
  });
  return matchMedia('(prefers-color-scheme: dark)').matches;
}
