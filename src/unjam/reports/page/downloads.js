// Adds links to download figures as SVG and tables as CSV, and marks tables that are wider than the screen.
(() => {
  const addLink = (element, text, name, address) => {
    const link = document.createElement("a");
    Object.assign(link, { className: "download", textContent: text, download: name, href: address });
    element.after(link);
  };
  const fileName = (text) => text.trim().toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "");
  const title = fileName(document.title);
  document.querySelectorAll(".picture").forEach((picture) => {
    const image = picture.querySelector("img");
    addLink(picture, "SVG", `${title}-${fileName(image.alt).slice(0, 40)}.svg`, image.src);
  });
  document.querySelectorAll(".scroll").forEach((scroll, number) => {
    const markWidth = () => scroll.classList.toggle("wide", scroll.scrollWidth > scroll.clientWidth + 1);
    markWidth();
    window.addEventListener("resize", markWidth);
    scroll.closest("details")?.addEventListener("toggle", markWidth);
    const quote = (cell) => `"${cell.textContent.replace(/\s+/g, " ").trim().replace(/"/g, '""')}"`;
    const lines = [...scroll.querySelectorAll("tr")].map((row) => [...row.cells].map(quote).join(","));
    const csv = new Blob([lines.join("\n") + "\n"], { type: "text/csv" });
    addLink(scroll, "CSV", `${title}-table-${number + 1}.csv`, URL.createObjectURL(csv));
  });
})();
