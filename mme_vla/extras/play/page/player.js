// The frames of an episode: fetched clip by clip, shown one at a time, played within bounds.

export const RATE = 30; // frames a second at speed 1

export class Player {
  constructor(canvas, changed) {
    this.context = canvas.getContext("2d");
    this.changed = changed; // called whenever the frame or the playing state is another
    this.clear();
  }

  clear() {
    this.images = [];
    this.at = 0;
    this.stop = 0; // the frame at which playing ends
    this.playing = false;
    this.speed = this.speed ?? 1;
    this.requested = null;
    this.rendering = false;
  }

  get last() {
    return this.images.length - 1;
  }

  // Adds the frames of one clip; `false` if the server no longer has them.
  async fetch(session, number, still) {
    const response = await fetch(`frames/${session}/${number}`);
    if (!response.ok) return false;
    const packed = await response.arrayBuffer();
    if (!still()) return false; // another episode began meanwhile
    const view = new DataView(packed);
    const count = view.getUint32(0, true);
    let start = 4 * (count + 1);
    for (let i = 1; i <= count; i++) {
      const size = view.getUint32(4 * i, true);
      this.images.push(new Blob([packed.slice(start, start + size)], { type: "image/jpeg" }));
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

  // Decoding takes time: of the frames requested meanwhile only the newest is shown.
  async draw() {
    this.changed();
    this.requested = this.at;
    if (this.rendering) return;
    this.rendering = true;
    while (this.requested !== null) {
      const image = this.images[this.requested];
      this.requested = null;
      if (!image) continue;
      const bitmap = await createImageBitmap(image);
      this.context.drawImage(bitmap, 0, 0);
      bitmap.close();
    }
    this.rendering = false;
  }
}
