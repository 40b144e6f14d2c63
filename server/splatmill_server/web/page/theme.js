// Sets the theme before the page is painted; it is the one script that is not a module, because modules run later.
(() => {
  try {
    const chosen = localStorage.getItem("splatmill.theme");
    if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
  } catch {
    // Storage is off in this browser: the system's theme holds.
  }
})();
