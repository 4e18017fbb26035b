// Offers each picture as SVG and each table as CSV; a table that is wider than the screen says so.
(() => {
  const offer = (place, words, name, address) => {
    const link = document.createElement("a");
    Object.assign(link, { className: "download", textContent: words, download: name, href: address });
    place.after(link);
  };
  const named = (text) => text.trim().toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "");
  const title = named(document.title);
  document.querySelectorAll(".picture").forEach((picture) => {
    const image = picture.querySelector("img");
    offer(picture, "SVG", `${title}-${named(image.alt).slice(0, 40)}.svg`, image.src);
  });
  document.querySelectorAll(".scroll").forEach((scroll, number) => {
    const look = () => scroll.classList.toggle("wide", scroll.scrollWidth > scroll.clientWidth + 1);
    look();
    window.addEventListener("resize", look);
    const quoted = (cell) => `"${cell.textContent.replace(/\s+/g, " ").trim().replace(/"/g, '""')}"`;
    const lines = [...scroll.querySelectorAll("tr")].map((row) => [...row.cells].map(quoted).join(","));
    offer(scroll, "CSV", `${title}-table-${number + 1}.csv`, URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" })));
  });
})();
