// Records that are decoded when they are needed; a few of them are kept.

const MAX_KEPT = 24;

class Decoded {
  // decode: promise of what record k holds; drop: frees it; ready: called when another one is there.
  constructor(decode, drop, ready) {
    Object.assign(this, { decode, drop, ready, kept: new Map(), wanted: [], busy: false });
  }

  // Ask for records, the most urgent first; of those asked for earlier only the one being decoded is still waited for.
  ask(indices) {
    this.wanted = indices.filter((k) => !this.kept.has(k));
    if (!this.busy) this.next();
  }

  // What a record holds; undefined until it is decoded, null when it cannot be.
  get(k) { return this.kept.get(k); }

  next() {
    const k = this.wanted.shift();
    if (k === undefined) return;
    this.busy = true;
    this.decode(k).catch(() => null).then((value) => {
      this.kept.set(k, value);
      for (const [old, what] of this.kept) {
        if (this.kept.size <= MAX_KEPT) break;
        this.kept.delete(old);
        if (what !== null) this.drop(what);
      }
      this.busy = false;
      this.ready();
      if (!this.busy) this.next();
    });
  }
}

const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

const inflate = async (text) => {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
};

// Index of the time nearest to t; -1 when it is farther away than `reach`.
const nearest = (times, t, reach) => {
  const before = lastUntil(times, t), after = before + 1;
  const k = before >= 0 && (after === times.length || t - times[before] <= times[after] - t) ? before : after;
  return k < times.length && Math.abs(times[k] - t) <= reach ? k : -1;
};

// How far from its time a record is shown: half a usual step and some more.
const reachOf = (times) => {
  const steps = times.slice(1).map((t, k) => t - times[k]);
  return Math.max(steps.length ? 0.75 * middle(steps) : 0, 0.3);
};
