// Pictures of alerts, fetched with the page's token when their card comes into sight.

const KEPT = 200;
const TRIES = 3;

export class Thumbnails {
  constructor(link) {
    this.link = link;
    this.tries = new Map(); // id → how often a new alert's picture is still asked for
    this.urls = new Map(); // id → object URL, or null where there is no picture
    this.seen = new IntersectionObserver((entries) => {
      for (const entry of entries) if (entry.isIntersecting) this.load(entry.target);
    }, { rootMargin: "200px" });
  }

  // Shows the picture of alert `id` in `image`; its parent takes no room while there is none, but can come into sight.
  show(image, id, isNew) {
    image.dataset.alert = id;
    if (isNew && !this.tries.has(id)) this.tries.set(id, TRIES);
    if (this.urls.has(id)) this.put(image, this.urls.get(id));
    else this.seen.observe(image);
  }

  put(image, url) {
    image.parentNode.classList.toggle("there", url !== null);
    if (url) image.src = url;
  }

  async load(image) {
    this.seen.unobserve(image);
    const id = image.dataset.alert;
    if (!this.urls.has(id)) {
      try {
        const answer = await this.link.request(`/v1/alerts/${encodeURIComponent(id)}/evidence.png?panels=data&scale=4`);
        this.keep(id, URL.createObjectURL(await answer.blob()));
      } catch (e) {
        if (e.status !== 404) return;
        // The picture of a new alert takes a moment to be drawn or recorded.
        const left = this.tries.get(id) ?? 0;
        this.tries.set(id, left - 1);
        if (left > 0 && image.isConnected) {
          setTimeout(() => this.load(image), 1500);
          return;
        }
        this.tries.delete(id);
        this.keep(id, null);
      }
    }
    this.put(image, this.urls.get(id) ?? null);
  }

  keep(id, url) {
    this.urls.set(id, url);
    if (this.urls.size <= KEPT) return;
    const [oldest, old] = this.urls.entries().next().value;
    this.urls.delete(oldest);
    if (old) URL.revokeObjectURL(old);
  }
}
