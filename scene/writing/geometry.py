"""All geometry files of a scene folder: the bore in its linings, whole, as MuJoCo scenes, and as its planar cut."""

from pathlib import Path

from scene.bore import Bore
from scene.writing import furniture, mesh, mjcf, planar
from scene.writing.furnished import furnish_bore, planar_segments
from scene.writing.mjcf import SceneConfig
from scene.writing.track import Track

SCENES = ("scene.xml", "scene_furnished.xml")


def write_geometry(
    folder: Path, name: str, provenance: str, bore: Bore, track: Track, config: SceneConfig
) -> tuple[dict[str, int], dict[str, str]]:
    """Writes `bore.npz`, `tunnel.npz`, both scenes and the whole meshes.

    Args:
        folder: Where to.
        name: Of the tunnel.
        provenance: What kind of recording the bore comes from.
        bore: The bore.
        track: Its track.
        config: How the scene is cut and dressed.

    Returns:
        How many of each asset there are, and where the furniture comes from.

    Raises:
        FitError: The bore makes no solid, or has no walls at the LiDAR's height.
    """
    furnished = furnish_bore(bore, track, config.furniture)
    solids = {"smooth": mesh.build_solid(bore, pockets=False)}
    solids["pockets"] = mesh.build_solid(bore, pockets=True) if len(bore.pocket) else solids["smooth"]
    solids["furnished"] = mesh.build_solid(furnished.bore, pockets=True) if furnished.niches else solids["pockets"]
    height = config.lidar_height
    walls = {variant: planar.cut_walls(solid, bore, track.elevation, height) for variant, solid in solids.items()}
    solid = mesh.as_trimesh(solids["pockets"])
    lining = mesh.open_lining(solid, bore)
    count = mjcf.write_scene(folder, name, bore, lining, walls["smooth"], track, config)
    with_niches = mesh.open_lining(mesh.as_trimesh(solids["furnished"]), bore) if furnished.niches else lining
    mjcf.write_scene(folder, name, bore, with_niches, walls["smooth"], track, config, furnished)
    solid.export(folder / "meshes" / "solid.ply")
    lining.export(folder / "meshes" / "lining.ply")
    smooth = mesh.open_lining(mesh.as_trimesh(solids["smooth"]), bore)
    smooth.export(folder / "meshes" / "lining_smooth.ply")
    bore.save(folder / "bore.npz")
    segments = {"furnished": planar_segments(furnished.pieces, bore, track.elevation, height)}
    planar.save(folder / "tunnel.npz", name, provenance, bore, track.elevation, height, walls, segments)
    placed = {f"furniture_{kind}": number for kind, number in furniture.counts(furnished.pieces).items()}
    count |= {**placed, "furniture_niche": len(furnished.niches), "lining_faces": len(lining.faces)}
    return count, {"furniture": "by standard, in the variant furnished alone"}
