// The frames of an episode: fetched clip by clip, drawn one at a time, played within bounds.

export const RATE = 30; // frames a second at speed 1

export class Film {
  constructor(canvas, changed) {
    this.context = canvas.getContext("2d");
    this.changed = changed; // called whenever the frame or the playing state is another
    this.clear();
  }

  clear() {
    this.pictures = [];
    this.at = 0;
    this.stop = 0; // the frame at which playing ends
    this.playing = false;
    this.speed = this.speed ?? 1;
    this.wanted = null;
    this.drawing = false;
  }

  get last() {
    return this.pictures.length - 1;
  }

  // Adds the frames of one clip; `false` if the server no longer has them.
  async fetch(session, number, still) {
    const answer = await fetch(`frames/${session}/${number}`);
    if (!answer.ok) return false;
    const packed = await answer.arrayBuffer();
    if (!still()) return false; // another episode began meanwhile
    const view = new DataView(packed);
    const count = view.getUint32(0, true);
    let start = 4 * (count + 1);
    for (let i = 1; i <= count; i++) {
      const size = view.getUint32(4 * i, true);
      this.pictures.push(new Blob([packed.slice(start, start + size)], { type: "image/jpeg" }));
      start += size;
    }
    return true;
  }

  seek(index) {
    this.at = Math.max(0, Math.min(this.last, Math.round(index)));
    this.draw();
  }

  play(from, stop) {
    if (this.last < 0) return;
    this.stop = Math.min(stop, this.last);
    this.exact = Math.min(from, this.stop);
    this.seek(this.exact);
    this.before = undefined;
    if (!this.playing) {
      this.playing = true;
      requestAnimationFrame((now) => this.tick(now));
    }
    this.changed();
  }

  pause() {
    this.playing = false;
    this.changed();
  }

  tick(now) {
    if (!this.playing) return;
    this.exact += this.before === undefined ? 0 : ((now - this.before) / 1000) * RATE * this.speed;
    this.before = now;
    if (this.exact >= this.stop) {
      this.seek(this.stop);
      this.pause();
      return;
    }
    this.seek(Math.floor(this.exact));
    requestAnimationFrame((next) => this.tick(next));
  }

  // Decoding takes a moment: of the frames asked for meanwhile only the newest is drawn.
  async draw() {
    this.changed();
    this.wanted = this.at;
    if (this.drawing) return;
    this.drawing = true;
    while (this.wanted !== null) {
      const picture = this.pictures[this.wanted];
      this.wanted = null;
      if (!picture) continue;
      const bitmap = await createImageBitmap(picture);
      this.context.drawImage(bitmap, 0, 0);
      bitmap.close();
    }
    this.drawing = false;
  }
}
