/* Browsers refuse a Worker to a page that was opened from the disk. There this one runs the script in a hidden frame, which is all that the search needs. */
(function () {
  if (location.protocol !== "file:") return;
  function FrameWorker(url) {
    url = new URL(url, location.href).href;
    var self = this, waiting = [], frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.appendChild(frame);
    var inner = frame.contentWindow, page = inner.document;
    page.open();
    page.write('<html><body></body></html>');
    page.close();
    inner = frame.contentWindow;
    var ready = false;
    this.listeners = [];
    this.onmessage = null;
    inner.importScripts = function () {
      return Array.prototype.reduce.call(arguments, function (before, source) {
        return before.then(function () {
          return new Promise(function (done, failed) {
            var script = inner.document.createElement("script");
            script.src = new URL(source, url).href;
            script.onload = done;
            script.onerror = failed;
            inner.document.body.appendChild(script);
          });
        });
      }, Promise.resolve());
    };
    inner.postMessage = function (data) {
      var event = new MessageEvent("message", { data: data });
      self.listeners.forEach(function (listener) { listener.call(self, event); });
      if (self.onmessage) self.onmessage(event);
    };
    this.deliver = function (data) { inner.dispatchEvent(new MessageEvent("message", { data: data })); };
    inner.importScripts(url).then(function () {
      ready = true;
      waiting.splice(0).forEach(self.deliver);
    });
    this.postMessage = function (data) { if (ready) self.deliver(data); else waiting.push(data); };
    this.addEventListener = function (name, listener) { if (name === "message") self.listeners.push(listener); };
    this.removeEventListener = function (name, listener) { self.listeners = self.listeners.filter(function (one) { return one !== listener; }); };
    this.terminate = function () { frame.remove(); };
  }
  window.Worker = FrameWorker;
})();
