// Pages without anything of their own to load: the glossary, and what stands at an address without a page.

import { startShell } from "../shell.js";

await startShell({ open: true, visitor: true });
