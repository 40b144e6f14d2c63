"""What axe-core finds wrong with a page for people who use it without seeing or pointing."""

from typing import Any

from playwright.sync_api import Page

from tests.support.programs import npm_package


def violations(page: Page) -> list[str]:
    """What axe-core calls serious or critical, with the elements."""
    page.evaluate((npm_package("axe-core") / "axe.min.js").read_text(encoding="utf-8"))
    result: dict[str, Any] = page.evaluate("axe.run(document)")
    assert len(result["passes"]) > 10, "it has looked at the page"
    rules = result["violations"]
    return [
        f"{rule['id']}: {[node['target'] for node in rule['nodes']]}"
        for rule in rules
        if rule["impact"] in ("serious", "critical")
    ]
