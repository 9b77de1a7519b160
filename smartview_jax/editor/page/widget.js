// Shows the editor in a notebook; its other modules are known by `addresses` (see widget.py).
export default {
  async render({ model, el }) {
    const root = document.createElement("div");
    root.style.height = "720px";
    el.append(root);
    const editor = await import(addresses["editor.js"]);
    const { Asker } = await import(addresses["connection.js"]);
    const asker = new Asker((message) => model.send(message));
    const pictures = new Map();
    const connection = {
      onUpdate: () => {}, onState: () => {},
      ask: (message) => asker.ask(message),
      picture: (view) => new Promise((resolve, reject) => {
        pictures.set(view, resolve);
        asker.ask({ do: "picture", view }).catch(reject);
      }),
      open: () => connection.onState("open"),
    };
    const receive = (answer, buffers) => {
      if (answer.type === "picture") {
        pictures.get(answer.view)?.(new Blob([buffers[0]], { type: "image/jpeg" }));
      }
      if (!asker.take(answer) && answer.type !== "picture") connection.onUpdate(answer);
    };
    model.on("msg:custom", receive);
    editor.start(root, connection);
    return () => model.off("msg:custom", receive);
  },
};
