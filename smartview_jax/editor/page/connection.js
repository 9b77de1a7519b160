// How the page talks to Python: over a web socket here, over Jupyter's comm in the widget.
// A connection has ask(message) -> Promise of the answer, picture(view) -> Promise of a Blob,
// and the callbacks onUpdate(message) and onState("open" | "closed").

export class Asker {
  // Numbers the messages, and gives every answer to whoever asked.
  constructor(send) {
    this.send = send; this.next = 1; this.waiting = new Map();
  }
  ask(message) {
    const number = this.next++;
    return new Promise((resolve, reject) => {
      this.waiting.set(number, { resolve, reject });
      this.send({ ...message, message: number });
    });
  }
  // True if this was an answer that somebody waits for.
  take(answer) {
    const one = this.waiting.get(answer.reply_to);
    if (!one) return false;
    this.waiting.delete(answer.reply_to);
    if (answer.type === "error") one.reject(new Error(answer.text)); else one.resolve(answer);
    return true;
  }
  failAll(text) {
    for (const one of this.waiting.values()) one.reject(new Error(text));
    this.waiting.clear();
  }
}

export function socketConnection() {
  let socket = null;
  const asker = new Asker((message) => {
    if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
    else asker.failAll("the server is not there: nothing was changed");
  });
  const connection = {
    onUpdate: () => {}, onState: () => {},
    ask: (message) => asker.ask(message),
    picture: async (view) => {
      const answer = await fetch(`picture/${encodeURIComponent(view)}`);
      if (!answer.ok) throw new Error(await answer.text());
      return answer.blob();
    },
    open,
  };
  function open() {
    socket = new WebSocket(`ws://${location.host}/socket`);
    socket.onopen = () => connection.onState("open");
    socket.onmessage = (event) => {
      const answer = JSON.parse(event.data);
      if (!asker.take(answer)) connection.onUpdate(answer);
    };
    socket.onclose = () => {
      asker.failAll("the connection was lost: every change that was answered is kept");
      connection.onState("closed");
      setTimeout(open, 1000);  // the server may be started again on the same port
    };
  }
  return connection;
}
