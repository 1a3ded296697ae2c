// Every file of a job, to download or to fetch by curl.
import { announce, button, card, h, table } from "./dom.js";
import { bytes, has, t } from "./text.js";

const curl = (file) => `curl -fsS -H "Authorization: Bearer $VASCULUM_KEY" -o '${file.name}' '${location.origin}${file.href}'`;

export function files(list) {
  const rows = list.map((f) => [
    [h("a", { href: f.href, download: f.name }, f.name), has(`file.${f.name}`) ? h("span", { class: "soft" }, ` ${t(`file.${f.name}`)}`) : null],
    bytes(f.bytes),
    button(t("files.curl"), async () => {
      await navigator.clipboard.writeText(curl(f));
      announce(t("files.copied", { name: f.name }));
    }, { class: "quiet small", "aria-label": t("files.curl_of", { name: f.name }), title: curl(f) }),
  ]);
  return card(t("files.title"), table(t("files.title"), [{ title: t("files.name") }, { title: t("files.size"), number: true }, { title: t("files.fetch") }], rows, { class: "files" }));
}
