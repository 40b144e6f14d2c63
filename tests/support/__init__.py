"""What several tests share: a tiny photographed scene, plans and engines for it, and where the real captures are."""
