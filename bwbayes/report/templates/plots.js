// Draws each plot of the page in place of its picture, which stays for paper and where this fails.
for (const shown of document.querySelectorAll("figure.plotted")) {
  const item = JSON.parse(shown.querySelector("script").textContent);
  shown.classList.add("live");
  Bokeh.embed.embed_item(item, shown.querySelector(".plot")).catch((error) => {
    shown.classList.remove("live");
    console.error(error);
  });
}
