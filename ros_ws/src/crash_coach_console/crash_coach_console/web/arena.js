// Draws an arena and what moves in it on a canvas. Metres in, pixels out; nothing is kept here.

import { shortName } from "./dom.js";

const LEAST_BODY_PX = 5;
const SMALL_M = 16; // an arena that is always shown whole
const LEAST_SHARE = 0.5; // of a larger one: never less than this is shown
const AROUND_M = 2;

/** Metres to pixels: the part [x1, y1, x2, y2], whole, centred; north is up. */
export function project([x1, y1, x2, y2], width, height) {
  const margin = Math.max(14, 0.03 * Math.min(width, height));
  const scale = Math.max(
    0.1, Math.min((width - 2 * margin) / (x2 - x1), (height - 2 * margin) / (y2 - y1)),
  );
  const left = (width - scale * (x2 - x1)) / 2;
  const top = (height - scale * (y2 - y1)) / 2;
  return {
    scale,
    x: (x) => left + scale * (x - x1),
    y: (y) => top + scale * (y2 - y),
  };
}

/** What to look at: the whole arena, or of a large one without places the part where things are. */
export function lookAt(arena, state, aspect) {
  const [x1, y1, x2, y2] = arena.walled_m;
  const size = Math.max(x2 - x1, y2 - y1);
  if (arena.cell_m > 0 || arena.sites_m.length || size <= SMALL_M) return arena.walled_m;
  const alive = arena.actors.flatMap((_, i) => (state.health[i] > 0 ? [i] : []));
  if (!alive.length) return arena.walled_m;
  const [xs, ys] = [alive.map((i) => state.poses[3 * i]), alive.map((i) => state.poses[3 * i + 1])];
  const [minX, maxX, minY, maxY] = [
    Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys),
  ];
  const width = Math.max(maxX - minX + 2 * AROUND_M, LEAST_SHARE * size);
  const height = Math.max(maxY - minY + 2 * AROUND_M, LEAST_SHARE * size);
  // As wide for its height as the canvas, as far as there is arena.
  const [left, right] = widen(minX, maxX, Math.max(width, height * aspect), x1, x2);
  const [low, high] = widen(minY, maxY, Math.max(height, width / aspect), y1, y2);
  return [left, low, right, high];
}

/** So long, around the middle of what is to be seen, and within the limits. */
function widen(from, to, wanted, low, high) {
  const length = Math.min(high - low, wanted);
  const start = Math.min(high - length, Math.max(low, (from + to - length) / 2));
  return [start, start + length];
}

export function bodyRadius(actor, view) {
  return Math.max(LEAST_BODY_PX, actor.radius_m * view.scale);
}

export function drawFloor(ctx, arena, view, colours, width, height, done) {
  ctx.fillStyle = colours.outside;
  ctx.fillRect(0, 0, width, height);
  const [x1, y1, x2, y2] = arena.walled_m;
  const box = [view.x(x1), view.y(y2), view.scale * (x2 - x1), view.scale * (y2 - y1)];
  ctx.fillStyle = colours.floor;
  ctx.fillRect(...box);
  ctx.fillStyle = colours.rough;
  for (const [a, b, c, d] of arena.rough_m) {
    ctx.fillRect(view.x(a), view.y(d), view.scale * (c - a), view.scale * (d - b));
  }
  if (arena.cell_m > 0) drawGrid(ctx, arena, view, colours);
  arena.sites_m.forEach((site, i) => drawSite(ctx, arena, view, colours, site, Boolean(done[i])));
  ctx.strokeStyle = colours.wall;
  ctx.lineWidth = 2;
  ctx.strokeRect(...box);
}

function drawGrid(ctx, arena, view, colours) {
  const [x1, y1, x2, y2] = arena.walled_m;
  ctx.strokeStyle = colours.grid;
  ctx.lineWidth = 1;
  ctx.beginPath();
  for (let x = x1 + arena.cell_m; x < x2 - 1e-6; x += arena.cell_m) {
    ctx.moveTo(view.x(x), view.y(y1));
    ctx.lineTo(view.x(x), view.y(y2));
  }
  for (let y = y1 + arena.cell_m; y < y2 - 1e-6; y += arena.cell_m) {
    ctx.moveTo(view.x(x1), view.y(y));
    ctx.lineTo(view.x(x2), view.y(y));
  }
  ctx.stroke();
}

function drawSite(ctx, arena, view, colours, [x, y], done) {
  const round = arena.site_radius_m > 0;
  const half = view.scale * (round ? arena.site_radius_m : arena.cell_m / 2);
  ctx.globalAlpha = 0.55;
  ctx.fillStyle = done ? colours.done : colours.site;
  ctx.beginPath();
  if (round) ctx.arc(view.x(x), view.y(y), half, 0, 2 * Math.PI);
  else ctx.rect(view.x(x) - half + 1, view.y(y) - half + 1, 2 * half - 2, 2 * half - 2);
  ctx.fill();
  ctx.globalAlpha = 1;
  if (half > 9) {
    label(ctx, done ? "✓" : arena.site_name, view.x(x), view.y(y), Math.min(12, half / 2 + 3),
      colours.faint);
  }
}

function label(ctx, text, x, y, size, colour, weight = 500) {
  ctx.font = `${weight} ${size}px system-ui, sans-serif`;
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  ctx.fillStyle = colour;
  ctx.fillText(text, x, y);
}

export function drawTrails(ctx, view, trails, colours, colourOf) {
  ctx.lineJoin = "round";
  ctx.lineCap = "round";
  for (const [robot, points] of trails.points) {
    ctx.strokeStyle = colourOf(robot);
    for (let k = 1; k < points.length; k += 1) {
      ctx.globalAlpha = 0.35 * (k / points.length);
      ctx.lineWidth = 1 + 2 * (k / points.length);
      ctx.beginPath();
      ctx.moveTo(view.x(points[k - 1].x), view.y(points[k - 1].y));
      ctx.lineTo(view.x(points[k].x), view.y(points[k].y));
      ctx.stroke();
    }
  }
  ctx.globalAlpha = 1;
}

/** Shots and bites: [{from, to, age}] with age from 0, just now, to 1, faded. */
export function drawHits(ctx, view, poses, hits, colours) {
  ctx.strokeStyle = colours.hit;
  for (const { from, to, age } of hits) {
    ctx.globalAlpha = 0.85 * (1 - age);
    ctx.lineWidth = 2;
    ctx.beginPath();
    ctx.moveTo(view.x(poses[3 * from]), view.y(poses[3 * from + 1]));
    ctx.lineTo(view.x(poses[3 * to]), view.y(poses[3 * to + 1]));
    ctx.stroke();
  }
  ctx.globalAlpha = 1;
}

/**
 * One body. mark: {tag, colour, dashed} of a crashed or lost robot, or null.
 */
export function drawBody(ctx, view, colours, actor, pose, life, mark, selected, fights) {
  const x = view.x(pose[0]);
  const y = view.y(pose[1]);
  if (actor.size_m[0] > 0) {
    drawBox(ctx, view, colours, actor, x, y, pose[2]);
    return;
  }
  const radius = bodyRadius(actor, view);
  if (life.health <= 0) {
    drawDead(ctx, x, y, radius, colours);
    return;
  }
  const colour = mark ? mark.colour : colours[actor.side];
  ctx.fillStyle = colour;
  ctx.globalAlpha = mark?.dashed ? 0.35 : 1;
  ctx.beginPath();
  ctx.arc(x, y, radius, 0, 2 * Math.PI);
  ctx.fill();
  ctx.globalAlpha = 1;
  if (mark) ring(ctx, x, y, radius + 3, colour, 2, mark.dashed ? [4, 3] : []);
  if (selected) ring(ctx, x, y, radius + 6, colours.selected, 2, []);
  if (radius >= 7) {
    const name = shortName(actor.name);
    label(ctx, name, x, y + 0.5, Math.min(15, radius * 1.05), colours.onBody, 650);
  }
  if (fights) drawLife(ctx, x, y - radius - 8, Math.max(20, 2 * radius), life, colours);
  if (mark) drawTag(ctx, x, y + radius + 13, mark, colours);
}

function ring(ctx, x, y, radius, colour, width, dash) {
  ctx.strokeStyle = colour;
  ctx.lineWidth = width;
  ctx.setLineDash(dash);
  ctx.beginPath();
  ctx.arc(x, y, radius, 0, 2 * Math.PI);
  ctx.stroke();
  ctx.setLineDash([]);
}

function drawBox(ctx, view, colours, actor, x, y, angle) {
  const [width, depth] = actor.size_m.map((side) => side * view.scale);
  ctx.save();
  ctx.translate(x, y);
  ctx.rotate(-angle);
  ctx.fillStyle = colours.things;
  ctx.strokeStyle = colours.ink;
  ctx.lineWidth = 1.5;
  ctx.beginPath();
  ctx.roundRect(-width / 2, -depth / 2, width, depth, 4);
  ctx.fill();
  ctx.stroke();
  ctx.restore();
}

function drawDead(ctx, x, y, radius, colours) {
  const half = Math.max(3, 0.5 * radius);
  ctx.strokeStyle = colours.faint;
  ctx.lineWidth = 2;
  ctx.beginPath();
  ctx.moveTo(x - half, y - half);
  ctx.lineTo(x + half, y + half);
  ctx.moveTo(x - half, y + half);
  ctx.lineTo(x + half, y - half);
  ctx.stroke();
}

function drawLife(ctx, x, y, width, life, colours) {
  const height = 4;
  ctx.fillStyle = colours.lack;
  ctx.fillRect(x - width / 2, y, width, height);
  ctx.fillStyle = life.health > 0.35 ? colours.health : colours.hurt;
  ctx.fillRect(x - width / 2, y, width * life.health, height);
  if (life.shield > 0) {
    ctx.fillStyle = colours.shield;
    ctx.fillRect(x - width / 2, y - 3, width * life.shield, 2);
  }
}

function drawTag(ctx, x, y, mark, colours) {
  ctx.font = "600 11px system-ui, sans-serif";
  const width = ctx.measureText(mark.tag).width + 10;
  ctx.fillStyle = mark.dashed ? colours.floor : mark.colour;
  ctx.strokeStyle = mark.colour;
  ctx.lineWidth = 1.5;
  ctx.setLineDash(mark.dashed ? [3, 2] : []);
  ctx.beginPath();
  ctx.roundRect(x - width / 2, y - 8, width, 16, 8);
  ctx.fill();
  ctx.stroke();
  ctx.setLineDash([]);
  label(ctx, mark.tag, x, y + 0.5, 11, mark.dashed ? mark.colour : "#ffffff", 600);
}
