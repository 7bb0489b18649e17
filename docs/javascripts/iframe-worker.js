// Browsers start no worker for a page that was opened as a file. The search then runs in a hidden frame instead, whose
// window gets the functions of a worker that the search uses: importScripts, postMessage and the message event.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const base = new URL(url, document.baseURI).href;
      const frame = document.createElement("iframe");
      frame.hidden = true;
      this.pending = []; // messages until the script is loaded
      frame.onload = async () => {
        this.inner = frame.contentWindow;
        this.inner.importScripts = async (...addresses) => {
          for (const address of addresses) await this.load(new URL(address, base).href);
        };
        // Not at once: a worker's messages arrive one after the other.
        this.inner.postMessage = (data) => setTimeout(() => this.dispatchEvent(new MessageEvent("message", { data })));
        await this.load(base);
        this.pending.forEach((data) => this.deliver(data));
        this.pending = null;
      };
      document.documentElement.append(frame);
    }
    load(address) {
      return new Promise((done, failed) => {
        const script = this.inner.document.createElement("script");
        script.src = address;
        script.onload = done;
        script.onerror = () => failed(new Error(`${address} was not loaded`));
        this.inner.document.head.append(script);
      });
    }
    deliver(data) {
      this.inner.dispatchEvent(new MessageEvent("message", { data }));
    }
    postMessage(data) {
      if (this.pending) this.pending.push(data);
      else this.deliver(data);
    }
  };
}
