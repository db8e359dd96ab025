"use strict";
for (const gallery of document.querySelectorAll(".gallery")) {
  const pick = gallery.querySelector(".pick"), box = gallery.querySelector(".cards");
  if (!pick) continue;
  const cards = [...box.children];
  pick.hidden = false; // without JavaScript the pictures stand as they are
  pick.addEventListener("change", () => {
    const [key, direction] = pick.querySelector("[data-sort]").value.split(" ");
    const filters = [...pick.querySelectorAll("[data-filter]")].filter((one) => one.value);
    for (const card of cards)
      card.hidden = filters.some((one) => "=" + card.dataset[one.dataset.filter] !== one.value);
    const value = (card) => {
      const text = card.dataset[key];
      return text === undefined ? Infinity : direction * (text === "inf" ? Infinity : Number(text));
    };
    const order = key ? [...cards].sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      return x < y ? -1 : x > y ? 1 : 0;
    }) : cards;
    box.append(...order);
  });
}
