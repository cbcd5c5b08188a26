"""Whatever texts a foreign folder holds, the report has the tags of a harmless one and the texts are only texts."""

import re
from html.parser import HTMLParser

import pandas as pd
import pytest

from kit.folders import made_up_row, write_folder
from servobench.harness.apps.report import page as report
from servobench.harness.batch import store
from servobench.harness.batch.results import ResultsFolder

PAYLOADS = (
    "<script>pwned=1</script>", "</script><script>pwned=1</script>", "</SCRIPT ><script>pwned=1</script>",
    "<!--<script>", "--><script>pwned=1</script>", "]]><script>pwned=1</script>", "<![CDATA[<script>]]>",
    "<img src=x onerror=pwned=1>", "<img src=x onerror=pwned=1//", "<svg onload=pwned=1>", "<svg/onload=pwned=1>",
    "<svg><script>pwned=1</script></svg>", "<math><mi xlink:href=\"javascript:pwned=1\">", "<body onload=pwned=1>",
    "<iframe src=javascript:pwned=1>", "<iframe srcdoc='<script>pwned=1</script>'>", "<object data=x>", "<embed src=x>",
    "<link rel=stylesheet href=//evil>", "<style>@import '//evil'</style>", "</style><script>pwned=1</script>",
    "<base href=//evil>", "<meta http-equiv=refresh content='0;url=//evil'>", "<form action=//evil><input type=submit>",
    "<a href='javascript:pwned=1'>x</a>", "<details open ontoggle=pwned=1>", "<video><source onerror=pwned=1></video>",
    "<input autofocus onfocus=pwned=1>", "<template><script>pwned=1</script></template>",
    "<noscript><p title='</noscript>",
    "\" onmouseover=\"pwned=1", "' onmouseover='pwned=1", "\"><script>pwned=1</script>", "'><script>pwned=1</script>",
    "` onmouseover=`pwned=1`", "`<b>bold</b>`", "`</code><script>pwned=1</script>`", "javascript:pwned=1",
    "data:text/html,<script>pwned=1</script>", "{{7*7}}", "{% raw %}{{ config }}{% endraw %}", "${7*7}",
    "$(touch pwned)",
    "&lt;script&gt;pwned=1&lt;/script&gt;", "&#60;script&#62;", "\\u003cscript\\u003epwned=1", "\u2028pwned=1\u2029",
    "\x00<script>pwned=1</script>", "<\u200bscript>pwned=1</\u200bscript>", "\u202e<script>pwned=1</script>",
)  # fmt: skip
SOFT = ("wbr", "code")  # tags that the report itself puts into a text


class Tags(HTMLParser):
    """Collects the tags of a page, with the names of their attributes."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags, self.others, self.words = list[tuple[str, ...]](), list[str](), list[str]()
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs) -> None:
        assert tag not in SOFT or not attrs
        if tag not in SOFT:
            self.tags.append((tag, *(name for name, _ in attrs)))
        assert not any(name.startswith("on") for name, _ in attrs)
        assert not any((value or "").strip().lower().startswith("javascript") for _, value in attrs)

    def handle_endtag(self, tag) -> None:
        if tag not in SOFT:
            self.tags.append((f"/{tag}",))

    def handle_comment(self, data) -> None:
        self.others.append(data)

    def handle_decl(self, decl) -> None:
        self.others.append(decl)

    def unknown_decl(self, data) -> None:
        self.others.append(data)

    def handle_data(self, data) -> None:
        self.words.append(data)


def page_with(text: str, folder) -> str:
    """Return the report on a folder of which every text is `text`: in the manifest, the tables and beside them."""
    plain = made_up_row("a")
    texts = {name: text for name, value in plain.items() if isinstance(value, str)} | {
        "outcome": text,
        "robot": text,
    }
    rows = [plain | texts | {"run_id": f"a{k}", "seed": k} for k in range(2)]
    rows.append(made_up_row("ends-well", reason=text, mismatch=text, seed=5))
    write_folder(folder, rows, [])
    manifest = {
        "created": text, "python": text, "platform": text, "git_commit": text, "seeds": text, "campaign": text,
        "plants": [text], "controllers": [text], "tasks": [text], "mismatches": [text], "engines": {text: text},
        "packages": {"servobench": text, text: text}, "configuration": {text: {text: text}},
        "own_controllers": {text: {"place": text, "sha256": text}}, "side_by_side": {text: [text]},
        "robots": [{"name": text, "title": text, "source": text, "note": text}],
    }  # fmt: skip
    store.write_manifest(folder, manifest)
    pd.DataFrame({text: [text]}).to_csv(folder / "claims.csv", index=False)
    return report.write_report(ResultsFolder(folder)).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def harmless(tmp_path_factory) -> Tags:
    return Tags(page_with("harmless", tmp_path_factory.mktemp("harmless") / "out"))


@pytest.mark.parametrize("payloads", [PAYLOADS[k::5] for k in range(5)], ids=range(5))
def test_payloads_in_every_text_of_a_folder_stay_texts(harmless, tmp_path, payloads):
    page = Tags(page_with(" ".join(payloads), tmp_path / "out"))
    assert page.tags == harmless.tags
    assert page.others == harmless.others
    shown = re.sub(r"[\s`\x00\ufffd]", "", "".join(page.words))
    assert [each for each in payloads if re.sub(r"[\s`\x00]", "", each) not in shown] == []
