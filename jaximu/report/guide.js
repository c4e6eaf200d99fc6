// A page that follows a recording: the server sends those of its parts that changed, by the ids of their elements.
"use strict";
const lost = document.getElementById("lost");
const source = new EventSource("events");
source.onmessage = (event) => {
  lost.hidden = true;
  for (const [id, html] of Object.entries(JSON.parse(event.data))) document.getElementById(id).innerHTML = html;
};
source.addEventListener("end", () => source.close());
source.onerror = () => { lost.hidden = false; };
