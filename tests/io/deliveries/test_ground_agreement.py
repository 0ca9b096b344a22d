from __future__ import annotations

import shutil

import pytest

from made_up_deliveries import maxar_delivery, planet_delivery, shots, write_single
from rpc_fixtures import rpb, rpc_txt
from zlocus.core.errors import InputError
from zlocus.io.deliveries.delivery import open_delivery
from zlocus.io.scene_file import open_scene, open_usable_views

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def taken(images):
    return shots({name: images("sine").paths[name] for name in ("nadir", "fore", "aft")})


def rpc_of(root, shot, kind):
    return next(root.glob(f"*_{shot.name}_basic_{kind}_dn_RPC.TXT"))


def test_the_rpc_of_one_image_beside_another_one(taken, tmp_path):
    root = planet_delivery(tmp_path / "d", taken)
    shutil.copy(rpc_of(root, taken[1], "panchromatic"), rpc_of(root, taken[0], "panchromatic"))
    with pytest.raises(InputError) as caught:
        open_delivery(root)
    first, second = (f"ssc2d1_{shot.name}_basic_panchromatic_dn.tif" for shot in taken[:2])
    assert first in str(caught.value)
    assert second in str(caught.value)
    assert "have the identical RPC" in str(caught.value)
    reasons = {each.reason for each in open_usable_views([root]).refused}
    assert reasons == {str(caught.value)}


def test_single_images_with_one_rpc(taken, tmp_path):
    paths = [write_single(tmp_path, shot) for shot in taken]
    shutil.copy(tmp_path / f"{taken[1].name}_RPC.TXT", tmp_path / f"{taken[0].name}_RPC.TXT")
    with pytest.raises(InputError, match=rf"{paths[0]} and {paths[1]} have the identical RPC"):
        open_scene(paths)
    usable = open_usable_views(paths)
    assert [each.name for each in usable.refused] == [shot.name for shot in taken[:2]]
    assert [view.name for view in usable.scene.views] == [taken[2].name]


def test_a_panchromatic_image_that_looks_from_elsewhere_than_its_multispectral_one(taken, tmp_path):
    """Both have the RPC of a third exposure, which is not in the delivery."""
    root = planet_delivery(tmp_path / "d", taken[:2])
    rpc_of(root, taken[0], "panchromatic").write_text(rpc_txt(taken[2].rpc))
    with pytest.raises(InputError, match=r"look at the ground from directions \d+ degrees apart") as caught:
        open_delivery(root)
    assert f"{taken[0].name}_basic_panchromatic_dn.tif" in str(caught.value)
    assert f"{taken[0].name}_basic_analytic_dn.tif" in str(caught.value)


def test_products_of_one_exposure_share_their_rpc(taken, tmp_path):
    """A pansharpened image has the RPC and the size of the panchromatic one."""
    root = maxar_delivery(tmp_path / "d", taken[:2])
    folder = next(root.glob("*P001_PAN"))
    (root / "sharpened").mkdir()
    for path in folder.iterdir():
        text = path.read_bytes().replace(b"P1BS", b"S1BS")
        (root / "sharpened" / path.name.replace("P1BS", "S1BS")).write_bytes(text)
    (next((root / "sharpened").glob("*.RPB"))).write_text(rpb(taken[0].rpc))
    assert len(open_delivery(root).views) == 3
