"""Writes scans with pydicom, nibabel and SimpleITK, reads them with `vasculum validate`, and compares both sides pixel by
pixel and corner by corner in mm (LPS).

    VASCULUM_BIN=FILE python tests/python/test_readers.py [WORD]     (only tests whose name holds WORD)

Needs numpy, pydicom (with pylibjpeg, gdcm and pyjpegls as decoders), nibabel, SimpleITK, pillow.
"""

import copy
import gzip
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import warnings

import gdcm
import nibabel
import numpy as np
import pydicom
import pydicom.data
import SimpleITK as sitk
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000,
    JPEG2000Lossless,
    JPEGLSLossless,
    JPEGLSNearLossless,
    RLELossless,
    generate_uid,
)

warnings.filterwarnings("ignore")
BIN = os.environ["VASCULUM_BIN"]
TEST_FILES = pathlib.Path(pydicom.data.__file__).parent / "test_files"
# printed decimals of positions and directions
MM = 1e-6
# NIfTI holds geometry in singles
MM_SINGLE = 2e-4


# ---- our side -------------------------------------------------------------------------------------------------------


class Read:
    """What `vasculum validate` says of some files."""

    def __init__(self, inputs, plan=None):
        inputs = [inputs] if isinstance(inputs, (str, pathlib.Path)) else list(inputs)
        with tempfile.TemporaryDirectory() as work:
            pixels = pathlib.Path(work) / "pixels"
            command = [BIN, "validate", "--json", "--threads", "1", "--pixels", str(pixels)]
            if plan is not None:
                path = pathlib.Path(work) / "plan.json"
                path.write_text(json.dumps(plan))
                command += ["--plan", str(path)]
            done = subprocess.run(command + [str(i) for i in inputs], capture_output=True, text=True, timeout=120)
            self.code = done.returncode
            self.problem = json.loads(done.stderr.splitlines()[-1]) if done.stderr.strip() else None
            self.input = None
            if done.stdout.strip():
                facts = json.loads(done.stdout)
                self.input, self.warnings = facts["input"], [w["code"] for w in facts["warnings"]]
                shape = [self.input[k] for k in ("slices", "rows", "columns")]
                values = np.fromfile(pixels, "<f4")
                count = int(np.prod(shape))
                self.pixels = values[:count].reshape(shape)
                # the mask, where there is one, follows as zeros and ones
                self.mask = values[count:].reshape(shape) if len(values) > count else None


def assert_same(read, array, affine, mm=MM, grey=0.0):
    """`array` is [slice, row, column]; `affine` takes (column, row, slice, 1) to LPS mm; slices may run either way."""
    assert read.input is not None, read.problem
    array = np.asarray(array, np.float64).astype(np.float32)
    assert read.pixels.shape == array.shape, (read.pixels.shape, array.shape)
    ends = [(0, n - 1) for n in array.shape]
    corners = np.array([(affine @ [c, r, s, 1.0])[:3] for s in ends[0] for r in ends[1] for c in ends[2]])
    ours = np.array(read.input["corners_mm"])
    # we sort slices along row x column
    if np.dot(np.cross(affine[:3, 0], affine[:3, 1]), affine[:3, 2]) < 0:
        corners, array = np.concatenate([corners[4:], corners[:4]]), array[::-1]
    off = np.abs(ours - corners).max()
    assert off <= mm, f"corners off by {off} mm:\n{ours}\n{corners}"
    wrong = np.abs(read.pixels.astype(np.float64) - array).max()
    assert wrong <= grey, f"grey values off by {wrong}"


def refused(read, code):
    assert read.code == 2 and read.input is None, read.input
    assert read.problem["code"] == code, read.problem


def folder():
    return pathlib.Path(tempfile.mkdtemp(prefix="readers-", dir=WORK))


# ---- scans -----------------------------------------------------------------------------------------------------------

OBLIQUE = np.array([[0.8, 0.6, 0.0], [-0.36, 0.48, -0.8], [-0.48, 0.64, 0.6]])  # rows: row, column, normal direction


def affine_of(directions, spacing, origin):
    """Affine of (column, row, slice); `spacing` in the same order."""
    a = np.eye(4)
    a[:3, :3] = (np.asarray(directions) * np.asarray(spacing)[:, None]).T
    a[:3, 3] = origin
    return a


AFFINE = affine_of(OBLIQUE, (0.7, 0.5, 1.5), (-20.5, 13.25, 40.0))


def noise(shape=(5, 40, 36), dtype=np.int16, low=-900, high=3000):
    return np.random.default_rng(7).integers(low, high, shape).astype(dtype)


def slice_of(pixels, position, directions=OBLIQUE, spacing=(0.5, 0.7)):
    """A minimal MR slice (`spacing` is [row step, column step])."""
    ds = Dataset()
    ds.SOPClassUID, ds.SOPInstanceUID = "1.2.840.10008.5.1.4.1.1.4", generate_uid()
    ds.Modality, ds.PatientName = "MR", "Smith^Canary"
    ds.StudyInstanceUID = ds.SeriesInstanceUID = ds.FrameOfReferenceUID = "1.2.3.4"
    ds.SeriesNumber = 1
    place(ds, position, directions, spacing)
    ds.SamplesPerPixel, ds.PhotometricInterpretation = 1, "MONOCHROME2"
    ds.Rows, ds.Columns = pixels.shape[-2:]
    bits = 8 * pixels.dtype.itemsize
    ds.BitsAllocated = ds.BitsStored = bits
    ds.HighBit, ds.PixelRepresentation = bits - 1, int(pixels.dtype.kind == "i")
    ds.PixelData = pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
    ds["PixelData"].VR = "OB" if bits == 8 else "OW"
    ds.file_meta = FileMetaDataset()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.file_meta.MediaStorageSOPClassUID = ds.SOPClassUID
    ds.file_meta.MediaStorageSOPInstanceUID = ds.SOPInstanceUID
    return ds


def place(ds, position, directions, spacing):
    ds.ImagePositionPatient = [float(x) for x in position]
    ds.ImageOrientationPatient = [float(x) for x in [*directions[0], *directions[1]]]
    ds.PixelSpacing = [float(x) for x in spacing]


def scan(array, affine=AFFINE):
    """Slices of an array as data sets."""
    return [slice_of(plane, affine[:3, 3] + affine[:3, 2] * k) for k, plane in enumerate(array)]


def saved(datasets, syntax=None):
    """Written by pydicom in an order that is not that of the slices."""
    out = folder()
    for k, ds in enumerate(datasets):
        ds = copy.deepcopy(ds)
        if syntax in (ImplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian):
            if syntax == ExplicitVRBigEndian and ds.BitsAllocated > 8:
                ds.PixelData = np.frombuffer(ds.PixelData, f"<u{ds.BitsAllocated // 8}").byteswap().tobytes()
            ds.file_meta.TransferSyntaxUID = syntax
        elif syntax is not None:
            compress(ds, syntax)
        ds.save_as(out / f"im{(k * 7) % 31:03}", enforce_file_format=True)
    return out


def compress(ds, syntax):
    options = {}
    if syntax == JPEG2000:
        options = {"j2k_cr": [4]}
    if syntax == JPEGLSNearLossless:
        options = {"jls_error": 3}
    ds.compress(syntax, generate_instance_uid=False, **options)


def decoded(path):
    """[slice, row, column] of a folder by pydicom, sorted along the normal, rescaled; the affine."""
    sets = [pydicom.dcmread(f) for f in path.iterdir()]
    normal = np.cross(sets[0].ImageOrientationPatient[:3], sets[0].ImageOrientationPatient[3:])
    sets.sort(key=lambda d: np.dot(d.ImagePositionPatient, normal))
    values = [
        d.pixel_array.astype(np.float64) * float(d.get("RescaleSlope", 1)) + float(d.get("RescaleIntercept", 0))
        for d in sets
    ]
    positions = np.array([d.ImagePositionPatient for d in sets], float)
    affine = np.eye(4)
    rows, columns = sets[0].PixelSpacing
    affine[:3, 0] = np.array(sets[0].ImageOrientationPatient[:3], float) * columns
    affine[:3, 1] = np.array(sets[0].ImageOrientationPatient[3:], float) * rows
    affine[:3, 2] = (positions[-1] - positions[0]) / (len(sets) - 1)
    affine[:3, 3] = positions[0]
    return np.array(values), affine


# ---- DICOM -----------------------------------------------------------------------------------------------------------


def test_dicom_transfer_syntaxes_that_lose_nothing():
    for array in [noise(), noise(dtype=np.uint16, low=0, high=65535), noise(dtype=np.uint8, low=0, high=255)]:
        syntaxes = [
            None,
            ImplicitVRLittleEndian,
            ExplicitVRBigEndian,
            DeflatedExplicitVRLittleEndian,
            RLELossless,
            JPEG2000Lossless,
            JPEGLSLossless,
        ]
        for syntax in syntaxes:
            try:
                assert_same(Read(saved(scan(array), syntax)), array, AFFINE)
            except AssertionError as e:
                raise AssertionError(f"{array.dtype} {syntax and syntax.name}: {e}") from e


def test_dicom_lossy_syntaxes_as_pydicom_decodes_them():
    smooth = np.add.outer(np.arange(4) * 40, np.add.outer(np.arange(40) ** 2, np.arange(50) * 9)).astype(np.uint16)
    path = saved(scan(smooth), JPEG2000)
    assert_same(Read(path), *decoded(path))
    for array in [smooth, (smooth % 251).astype(np.uint8)]:
        path = saved(scan(array), JPEGLSNearLossless)
        assert_same(Read(path), *decoded(path))


def test_jpeg_lossless_of_gdcm():
    for array in [noise(), noise(dtype=np.uint16, low=0, high=4095), noise(dtype=np.uint8, low=0, high=255)]:
        for process in [gdcm.TransferSyntax.JPEGLosslessProcess14_1, gdcm.TransferSyntax.JPEGLosslessProcess14]:
            path = saved(scan(array))
            for file in path.iterdir():
                gdcm_compressed(file, process)
            assert_same(Read(path), array, AFFINE)


def gdcm_compressed(file, process):
    reader = gdcm.ImageReader()
    reader.SetFileName(str(file))
    assert reader.Read()
    change = gdcm.ImageChangeTransferSyntax()
    change.SetTransferSyntax(gdcm.TransferSyntax(process))
    change.SetInput(reader.GetImage())
    assert change.Change()
    writer = gdcm.ImageWriter()
    writer.SetFile(reader.GetFile())
    writer.SetImage(change.GetOutput())
    writer.SetFileName(str(file))
    assert writer.Write()


# what cannot or must not be read of pydicom's own files, with the reason as a code
REFUSED = {
    "JPEG-lossy.dcm": "input.unsupported",  # 12-bit lossy JPEG
    "JPGExtended.dcm": "input.unsupported",  # 12-bit lossy JPEG
    "JPEG2000-embedded-sequence-delimiter.dcm": "input.malformed",  # pydicom cannot decode it either
    "MR_truncated.dcm": "input.truncated",
    "rtdose.dcm": "input.geometry_missing",  # frames without a place each
    "rtdose_expb.dcm": "input.geometry_missing",
    "rtdose_rle.dcm": "input.geometry_missing",
}


def test_every_grey_file_of_pydicom():
    """Each file's image, whatever it shows, at three positions: the pixels are left as they lie in the file."""
    seen = 0
    for file in sorted(TEST_FILES.glob("*.dcm")):
        if file.name == "badVR.dcm":
            continue  # pydicom cannot write it back
        try:
            ds = pydicom.dcmread(file, force=True)
            if "Rows" not in ds or not ds.PhotometricInterpretation.startswith("MONO") or ds.BitsAllocated == 1:
                continue
        except (AttributeError, pydicom.errors.InvalidDicomError):
            continue
        out = folder()
        for k in range(3):
            at = copy.deepcopy(ds)
            at.SOPInstanceUID = generate_uid()
            if at.get("Modality") == "RTDOSE" and int(at.get("NumberOfFrames") or 1) == 1:
                at.Modality = "MR"
            place(at, AFFINE[:3, 3] + k * AFFINE[:3, 2], OBLIQUE, (0.5, 0.7))
            at.save_as(out / f"{k}.dcm", enforce_file_format=False)
        read = Read(out)
        if file.name in REFUSED:
            refused(read, REFUSED[file.name])
            continue
        try:
            value = decoded(out)[0][0]
            assert_same(read, [value] * 3, AFFINE)
        except AssertionError as e:
            raise AssertionError(f"{file.name}: {e}") from e
        seen += 1
    assert seen >= 19, seen


def test_rescale_bits_and_overlays():
    array = noise(dtype=np.uint16, low=0, high=4095)
    sets = scan(array | 0xA000)  # old overlays in the high bits
    for k, ds in enumerate(sets):
        ds.BitsStored, ds.HighBit = 12, 11
        ds.RescaleSlope, ds.RescaleIntercept = 0.5 + 0.25 * k, -1024
    values = np.array([p * (0.5 + 0.25 * k) - 1024.0 for k, p in enumerate(array.astype(float))])
    assert_same(Read(saved(sets)), values, AFFINE)
    signed = noise(low=-2048, high=2047)
    sets = scan((signed & 0xFFF).astype(np.uint16))
    for ds in sets:
        ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 12, 11, 1
    assert_same(Read(saved(sets)), signed, AFFINE)


def enhanced(array, affine, order, stacks=None):
    """An enhanced MR image with one functional group per frame, frames in the given order."""
    ds = slice_of(array[0], [0, 0, 0])
    for name in ["ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"]:
        delattr(ds, name)
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.4.1"
    ds.NumberOfFrames = len(array)
    ds.PixelData = array[order].tobytes()
    shared, measures, direction = Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, measures.SliceThickness = [0.5, 0.7], 2.0
    direction.ImageOrientationPatient = [float(x) for x in [*OBLIQUE[0], *OBLIQUE[1]]]
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = Sequence([measures]), Sequence([direction])
    ds.SharedFunctionalGroupsSequence = Sequence([shared])
    frames = []
    for k in order:
        frame, position, value = Dataset(), Dataset(), Dataset()
        position.ImagePositionPatient = [float(x) for x in affine[:3, 3] + k * affine[:3, 2]]
        value.RescaleSlope, value.RescaleIntercept, value.RescaleType = 1 + 0.5 * float(k), -10 * int(k), "US"
        frame.PlanePositionSequence = Sequence([position])
        frame.PixelValueTransformationSequence = Sequence([value])
        frames.append(frame)
    ds.PerFrameFunctionalGroupsSequence = Sequence(frames)
    return ds


def test_enhanced_multi_frame_with_groups_per_frame():
    array = noise()
    order = np.array([3, 0, 4, 1, 2])
    values = np.array([p * (1 + 0.5 * k) - 10 * k for k, p in enumerate(array.astype(float))])
    for syntax in [None, ImplicitVRLittleEndian, ExplicitVRBigEndian, RLELossless, JPEG2000Lossless, JPEGLSLossless]:
        read = Read(saved([enhanced(array, AFFINE, order)], syntax))
        assert_same(read, values, AFFINE)
        assert read.input["thickness_mm"] == 2.0


def test_several_series_the_largest_consistent_one_or_the_plans():
    large, small = noise((6, 40, 36)), noise((4, 9, 11))
    sets = scan(large) + scan(small)
    for ds in sets[6:]:
        ds.SeriesInstanceUID, ds.SeriesNumber = "1.2.3.5", 7
    path = saved(sets)
    read = Read(path)
    assert_same(read, large, AFFINE)
    assert "dicom.several_series" in read.warnings
    for name in ["7", "1.2.3.5"]:
        assert_same(Read(path, {"series": name}), small, AFFINE)
    refused(Read(path, {"series": "8"}), "dicom.no_such_series")
    # time points in one place make no stack: the longest series that does is taken
    repeated = scan(large) + scan(large)
    sets = scan(small)
    for ds in repeated:
        ds.SeriesInstanceUID, ds.SeriesNumber = "1.2.3.6", 9
    read = Read(saved(repeated + sets))
    assert_same(read, small, AFFINE)
    assert "dicom.several_series" in read.warnings
    equal = scan(large) + scan(noise((6, 9, 11)))
    for ds in equal[6:]:
        ds.SeriesInstanceUID = "1.2.3.5"
    refused(Read(saved(equal)), "dicom.ambiguous_series")


def test_localisers_and_reports_are_left_out():
    array = noise()
    sets = scan(array)
    for axes in [[1, 2, 0], [2, 0, 1]]:
        plane = slice_of(noise((1, 40, 36))[0], [0, 0, 0], OBLIQUE[axes])
        sets.append(plane)
    report = pydicom.dcmread(TEST_FILES / "reportsi.dcm")
    path = saved(sets)
    report.save_as(path / "report")
    read = Read(path)
    assert_same(read, array, AFFINE)
    assert "dicom.several_series" in read.warnings and "dicom.not_an_image" in read.warnings


def test_missing_slices_are_gaps():
    array = noise((9, 40, 36))
    sets = scan(array)
    read = Read(saved([ds for k, ds in enumerate(sets) if k not in (3, 4, 6)]))
    assert read.input["missing_slices"] == [3, 4, 6]
    assert read.warnings.count("stack.gap") == 2
    kept = [0, 1, 2, 5, 7, 8]
    assert (read.pixels == array[kept]).all()
    ends = np.array(read.input["corners_mm"])
    assert np.abs(ends[4] - (AFFINE @ [0, 0, 8, 1])[:3]).max() < MM


def test_gantry_tilt_is_refused():
    sheared = AFFINE.copy()
    sheared[:3, 2] += 0.2 * OBLIQUE[1]
    refused(Read(saved(scan(noise(), sheared))), "dicom.gantry_tilt")


def test_slices_against_the_order_of_their_normal():
    backwards = AFFINE.copy()
    backwards[:3, 2] *= -1
    assert_same(Read(saved(scan(noise(), backwards))), noise(), backwards)


# ---- volumes ---------------------------------------------------------------------------------------------------------

RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def nifti_truth(image):
    """[slice, row, column] and LPS affine of (column, row, slice) as nibabel sees the file."""
    return np.asarray(image.get_fdata()).transpose(2, 1, 0), RAS @ image.affine


def check_nifti(path):
    assert_same(Read(path), *nifti_truth(nibabel.load(path)), mm=MM_SINGLE)


def test_nifti_types_orders_and_scales():
    for dtype in "int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64".split():
        values = noise((10, 12, 5), np.dtype(dtype), 0, 120)
        for order in "<>":
            header = nibabel.Nifti1Header(endianness=order)
            header.set_data_dtype(np.dtype(dtype).newbyteorder(order))
            image = nibabel.Nifti1Image(values, RAS @ AFFINE, header, dtype=dtype)
            path = folder() / "a.nii"
            nibabel.save(image, path)
            check_nifti(path)
    image = nibabel.Nifti1Image(noise((10, 12, 5)), RAS @ AFFINE)
    image.header.set_slope_inter(0.25, -100)
    for name in ["a.nii", "a.nii.gz"]:
        path = folder() / name
        nibabel.save(image, path)
        check_nifti(path)


def test_nifti_sform_qform_pixdim_in_that_order():
    values = noise((10, 12, 5))
    other = affine_of(np.eye(3), (0.7, 0.5, 1.5), (1, 2, 3))
    for sform, qform in [(2, 1), (1, 0), (0, 1), (0, 2), (0, 0)]:
        image = nibabel.Nifti1Image(values, None)
        image.header.set_zooms((0.7, 0.5, 1.5))
        image.set_sform(RAS @ other, code=sform)
        image.set_qform(RAS @ AFFINE, code=qform)
        path = folder() / "a.nii"
        nibabel.save(image, path)
        if sform == qform == 0:
            # nibabel centres such a volume and flips x; the standard's method 1 does neither
            read = Read(path)
            assert "nifti.no_orientation" in read.warnings
            array = values.transpose(2, 1, 0)
            assert_same(read, array, RAS @ affine_of(np.eye(3), (0.7, 0.5, 1.5), (0, 0, 0)), mm=MM_SINGLE)
        else:
            check_nifti(path)
    for flips in range(8):
        signs = [1 - 2 * (flips >> a & 1) for a in range(3)]
        path = folder() / "a.nii"
        nibabel.save(nibabel.Nifti1Image(values, RAS @ AFFINE @ np.diag([*signs, 1])), path)
        check_nifti(path)


def test_nifti_2_and_pairs():
    values = noise((10, 12, 5))
    for order in "<>":
        header = nibabel.Nifti2Header(endianness=order)
        header.set_data_dtype(np.dtype(np.int16).newbyteorder(order))
        path = folder() / "a.nii"
        nibabel.save(nibabel.Nifti2Image(values, RAS @ AFFINE, header), path)
        assert_same(Read(path), *nifti_truth(nibabel.load(path)))
    out = folder()
    nibabel.save(nibabel.Nifti1Pair(values, RAS @ AFFINE), out / "a.img")
    assert_same(Read(out), *nifti_truth(nibabel.load(out / "a.img")), mm=MM_SINGLE)


def itk_image(array, directions=OBLIQUE):
    image = sitk.GetImageFromArray(array)
    image.SetSpacing((0.7, 0.5, 1.5))
    image.SetOrigin((-20.5, 13.25, 40.0))
    image.SetDirection(np.asarray(directions).T.ravel().tolist())
    return image


def itk_truth(image):
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
    affine[:3, 3] = image.GetOrigin()
    return sitk.GetArrayFromImage(image), affine


def test_metaimage_and_nrrd_as_itk_writes_them():
    for name in ["a.mha", "a.mhd", "a.nrrd", "a.nhdr", "a.nii.gz"]:
        for compressed in [False, True]:
            for signs in [(1, 1, 1), (-1, 1, 1), (1, -1, -1), (-1, -1, -1)]:
                image = itk_image(noise(), OBLIQUE * np.array(signs)[:, None])
                out = folder()
                sitk.WriteImage(image, out / name, useCompression=compressed)
                again = sitk.ReadImage(out / name)
                assert_same(Read(out), *itk_truth(again), mm=MM_SINGLE if "nii" in name else 1e-5)
    for dtype in "int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64".split():
        for name in ["a.mha", "a.nrrd"]:
            out = folder()
            image = itk_image(noise((5, 12, 10), np.dtype(dtype), 0, 120))
            sitk.WriteImage(image, out / name)
            assert_same(Read(out), *itk_truth(image), mm=1e-5)


def test_dicom_as_itk_writes_it():
    """The other way round: what SimpleITK (GDCM) reads of pydicom's slices is what we read."""
    path = saved(scan(noise()))
    names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(path))
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(names)
    assert_same(Read(path), *itk_truth(reader.Execute()), mm=1e-5)


# ---- label masks -----------------------------------------------------------------------------------------------------


def mask_of(shape=(5, 40, 36)):
    """Labels 1 and 4: a slanted block and a small one."""
    mask = np.zeros(shape, np.uint8)
    for k in range(shape[0]):
        mask[k, 10 + k : 22 + k, 9:20] = 1
    mask[1:3, 30:34, 28:32] = 4
    return mask


def segmentation(mask, affine, segments, kind="BINARY"):
    """A DICOM segmentation as the standard's A.51 has it: one frame per segment and slice that shows it."""
    ds = enhanced(mask.astype(np.int16), affine, np.arange(len(mask)))
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.66.4"
    ds.Modality, ds.SegmentationType = "SEG", kind
    frames, pixels = [], []
    for number in segments:
        for k, plane in enumerate(mask):
            if not (plane == number).any():
                continue
            frame, position, of = Dataset(), Dataset(), Dataset()
            position.ImagePositionPatient = [float(x) for x in affine[:3, 3] + k * affine[:3, 2]]
            of.ReferencedSegmentNumber = number
            frame.PlanePositionSequence, frame.SegmentIdentificationSequence = Sequence([position]), Sequence([of])
            frames.append(frame)
            pixels.append(plane == number)
    ds.NumberOfFrames = len(frames)
    ds.PerFrameFunctionalGroupsSequence = Sequence(frames)
    bits = 1 if kind == "BINARY" else 8
    ds.BitsAllocated = ds.BitsStored = bits
    ds.HighBit, ds.PixelRepresentation = bits - 1, 0
    if kind == "BINARY":
        ds.PixelData = pydicom.pixels.pack_bits(np.array(pixels).astype(np.uint8).ravel())
    else:
        ds.MaximumFractionalValue = 200
        ds.PixelData = (np.array(pixels) * 200).astype(np.uint8).tobytes()
    ds["PixelData"].VR = "OB"
    return ds


def marked(read):
    assert read.input is not None, read.problem
    return read.input["mask_voxels"]


def test_masks_of_nibabel_and_itk_on_dicom():
    mask = mask_of()
    for flips in range(8):
        step = [slice(None, None, 1 - 2 * (flips >> a & 1)) for a in range(3)]
        for turned in [False, True]:
            path = saved(scan(noise()))
            # the same voxels in another order: flipped, and with its first two axes exchanged
            signs = [1 - 2 * (flips >> (2 - a) & 1) for a in range(3)]
            affine = AFFINE @ np.diag([*signs, 1.0])
            last = [(n - 1) * (s < 0) for n, s in zip(mask.shape[::-1], signs)]
            affine[:3, 3] = (AFFINE @ [*last, 1.0])[:3]
            values = mask[tuple(step)].transpose(2, 1, 0)
            if turned:
                values, affine = values.transpose(1, 0, 2), affine[:, [1, 0, 2, 3]]
            nibabel.save(nibabel.Nifti1Image(np.ascontiguousarray(values), RAS @ affine), path / "scan_seg.nii.gz")
            for label in (1, 4):
                read = Read(path, {"segmentation": {"label": label}})
                assert marked(read) == (mask == label).sum()
                assert (read.mask == (mask == label)).all()
            refused(Read(path), "mask.label")
    out = folder()
    image = itk_image(mask)
    sitk.WriteImage(itk_image(noise()), out / "a.nrrd")
    sitk.WriteImage(image, out / "label.nrrd", useCompression=True)
    assert (Read(out, {"segmentation": {"label": 4}}).mask == (mask == 4)).all()


def test_dicom_segmentations():
    mask = mask_of()
    for kind in ["BINARY", "FRACTIONAL"]:
        for syntax in [None, ImplicitVRLittleEndian, DeflatedExplicitVRLittleEndian]:
            path = saved(scan(noise()))
            written = saved([segmentation(mask, AFFINE, [1, 4], kind)], syntax)
            (written / "im000").rename(path / "segments")
            for label in (1, 4):
                read = Read(path, {"segmentation": {"label": label}})
                assert_same(read, noise(), AFFINE)
                assert (read.mask == (mask == label)).all(), (kind, label)
            refused(Read(path), "mask.label")
    path = saved(scan(noise()))
    (saved([segmentation(mask, AFFINE, [1])]) / "im000").rename(path / "segments")
    assert (Read(path).mask == (mask == 1)).all()


def test_a_mask_off_the_scans_voxels_is_refused():
    shifted = AFFINE.copy()
    shifted[:3, 3] += 0.3 * AFFINE[:3, 0]
    path = saved(scan(noise()))
    nibabel.save(nibabel.Nifti1Image((mask_of() == 1).astype(np.uint8).transpose(2, 1, 0), RAS @ shifted), path / "mask.nii")
    refused(Read(path), "mask.geometry")


def test_a_mask_alone_is_its_own_image():
    mask = (mask_of() == 1).astype(np.uint8)
    out = folder()
    nibabel.save(nibabel.Nifti1Image(mask.transpose(2, 1, 0), RAS @ AFFINE), out / "mask.nii")
    read = Read(out)
    assert_same(read, mask, AFFINE, mm=MM_SINGLE)
    assert read.input["format"] == "mask" and "mask.alone" in read.warnings and (read.mask == mask).all()


# ---- pictures --------------------------------------------------------------------------------------------------------

PLAN = {
    "geometry": {
        "pixel_spacing_mm": [0.5, 0.7],
        "slice_spacing_mm": 1.5,
        "origin_mm": [-20.5, 13.25, 40.0],
        "row_direction": OBLIQUE[0].tolist(),
        "column_direction": OBLIQUE[1].tolist(),
    }
}


def test_pictures_in_name_order():
    eight, sixteen = noise((12, 12, 10), np.uint8, 0, 255), noise((12, 12, 10), np.uint16, 0, 65535)
    for array, names in [(eight, ["png", "tif", "pgm"]), (sixteen, ["png", "tif"])]:
        for extension in names:
            out = folder()
            for k, plane in enumerate(array):
                Image.fromarray(plane).save(out / f"slice{k + 1}.{extension}")
            assert_same(Read(out, PLAN), array, AFFINE)
    for dtype in [np.int16, np.uint16, np.uint8, np.float32]:
        for compressed in [False, True]:
            out = folder()
            array = noise((12, 12, 10), dtype, 0, 120)
            image = sitk.GetImageFromArray(array)
            sitk.WriteImage(image, out / "stack.tif", useCompression=compressed)
            assert_same(Read(out / "stack.tif", PLAN), array, AFFINE)


def test_multi_page_tiff_of_pillow():
    array = noise((12, 12, 10), np.uint16, 0, 65535)
    for compression in [None, "tiff_lzw", "tiff_adobe_deflate", "packbits"]:
        path = folder() / "a.tif"
        pages = [Image.fromarray(p) for p in array]
        pages[0].save(path, save_all=True, append_images=pages[1:], compression=compression)
        assert_same(Read(path, PLAN), array, AFFINE)


def test_jpeg_as_pillow_decodes_it():
    smooth = np.add.outer(np.arange(4) * 9, np.add.outer(np.arange(40), 2 * np.arange(50))).astype(np.uint8)
    out, values = folder(), []
    for k, plane in enumerate(smooth):
        Image.fromarray(plane).save(out / f"{k}.jpg", quality=95)
        values.append(np.asarray(Image.open(out / f"{k}.jpg")))
    # decoders may round their cosine transform differently
    assert_same(Read(out, PLAN), values, AFFINE, grey=1.0)


def test_colour_is_refused():
    out = folder()
    for k in range(3):
        Image.fromarray(noise((12, 10, 3), np.uint8, 0, 255)).save(out / f"{k}.png")
    refused(Read(out, PLAN), "input.colour")


if __name__ == "__main__":
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    failed = []
    with tempfile.TemporaryDirectory() as WORK:
        for name, test in sorted(globals().items()):
            if name.startswith("test_") and word in name:
                try:
                    test()
                    print("ok", name, flush=True)
                except Exception as e:
                    failed.append(name)
                    print(f"FAILED {name}: {type(e).__name__}: {e}", flush=True)
    sys.exit(f"{len(failed)} failed: {', '.join(failed)}" if failed else 0)
