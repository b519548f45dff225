"""What readers of files share: their base class, scene and options, and where label maps are looked for."""
