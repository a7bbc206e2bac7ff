//! GeoTIFF (OGC 19-008r4): one band of heights in metres, by latitude and longitude or UTM, on WGS-84.

use std::io::{Read, Seek};

use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use super::error::Fault;
use super::raster::{Georeference, Projection, Raster, Vertical, Window, height};
use super::utm::Zone;

/// XML of GDAL, which may say that values are scaled.
const GDAL_METADATA: Tag = Tag::Unknown(42112);

/// Keys of the geo key directory, and values.
const MODEL_TYPE: u16 = 1024;
const PROJECTED: u16 = 1;
const GEOGRAPHIC: u16 = 2;
const RASTER_TYPE: u16 = 1025;
const PIXEL_IS_POINT: u16 = 2;
const GEODETIC_CRS: u16 = 2048;
const ANGULAR_UNITS: u16 = 2054;
const DEGREE: u16 = 9102;
const PROJECTED_CRS: u16 = 3072;
const LINEAR_UNITS: u16 = 3076;
const VERTICAL: u16 = 4096;
const VERTICAL_UNITS: u16 = 4099;
const METRE: u16 = 9001;
const USER_DEFINED: u16 = 32767;
/// WGS-84 by latitude and longitude, with and without ellipsoidal heights; the vertical code that old files give for them.
const WGS84: u16 = 4326;
const WGS84_3D: u16 = 4979;
const WGS84_ELLIPSOID: u16 = 5030;

/// An open file.
pub struct GeoTiff<R: Read + Seek> {
    decoder: Decoder<R>,
    size: [usize; 2],
    georeference: Georeference,
    void: Option<f64>,
}

/// The short values of a geo key directory.
struct GeoKeys(Vec<[u16; 4]>);

impl GeoKeys {
    fn get(&self, key: u16) -> Option<u16> {
        // A key with a location holds no short value.
        let found = self.0.iter().find(|entry| entry[0] == key && entry[1] == 0);
        found.map(|entry| entry[3])
    }

    /// Refuses units other than `unit`.
    fn expect_units(&self, key: u16, unit: u16, expected: &'static str) -> Result<(), Fault> {
        match self.get(key) {
            Some(found) if found != unit => Err(Fault::wrong(expected, format!("units EPSG:{found}"))),
            _ => Ok(()),
        }
    }

    fn projection(&self) -> Result<Projection, Fault> {
        let (code, projection) = match self.get(MODEL_TYPE) {
            Some(GEOGRAPHIC) => {
                self.expect_units(ANGULAR_UNITS, DEGREE, "degrees (EPSG:9102)")?;
                let code = self.get(GEODETIC_CRS);
                let is_wgs84 = matches!(code, Some(WGS84 | WGS84_3D));
                (code, is_wgs84.then_some(Projection::Geographic))
            }
            Some(PROJECTED) => {
                self.expect_units(LINEAR_UNITS, METRE, "metres (EPSG:9001)")?;
                let code = self.get(PROJECTED_CRS);
                (code, code.and_then(Zone::of_epsg).map(Projection::Utm))
            }
            _ => (None, None),
        };
        projection.ok_or_else(|| Fault::Projection {
            found: match code {
                None => "a file that names none".to_owned(),
                Some(USER_DEFINED) => "one that is user-defined".to_owned(),
                Some(code) => format!("EPSG:{code}"),
            },
        })
    }

    fn vertical(&self) -> Result<Vertical, Fault> {
        self.expect_units(VERTICAL_UNITS, METRE, "heights in metres (EPSG:9001)")?;
        let horizontal = [GEODETIC_CRS, PROJECTED_CRS].map(|key| self.get(key));
        Ok(match self.get(VERTICAL) {
            Some(WGS84_3D | WGS84_ELLIPSOID) => Vertical::Ellipsoid,
            Some(USER_DEFINED) => Vertical::Unstated,
            Some(_) => Vertical::SeaLevel,
            None if horizontal.contains(&Some(WGS84_3D)) => Vertical::Ellipsoid,
            None => Vertical::Unstated,
        })
    }
}

impl<R: Read + Seek> GeoTiff<R> {
    pub fn open(reader: R) -> Result<Self, Fault> {
        let mut decoder = Decoder::new(reader)?;
        let (width, rows) = decoder.dimensions()?;
        let size = [width as usize, rows as usize];
        let color = decoder.colortype()?;
        if !matches!(color, ColorType::Gray(16 | 32 | 64)) {
            return Err(Fault::wrong("one band of 16, 32 or 64 bits", format!("{color:?}")));
        }
        let mut numbers = |tag| decoder.find_tag(tag)?.map(|value| value.into_f64_vec()).transpose();
        let transformation = numbers(Tag::ModelTransformationTag)?;
        let (scale, tie) = (numbers(Tag::ModelPixelScaleTag)?, numbers(Tag::ModelTiepointTag)?);
        let keys = decoder.find_tag(Tag::GeoKeyDirectoryTag)?;
        let keys = keys.map(|keys| keys.into_u16_vec()).transpose()?.unwrap_or_default();
        let keys = GeoKeys(keys.as_chunks::<4>().0.iter().skip(1).copied().collect());
        let mut text = |tag| decoder.find_tag(tag)?.map(|value| value.into_string()).transpose();
        let void = text(Tag::GdalNodata)?.map(|text| {
            let found = text.trim_end_matches('\0').trim().parse();
            found.map_err(|_| Fault::wrong("a number in GDAL_NODATA", format!("{text:?}")))
        });
        if text(GDAL_METADATA)?
            .is_some_and(|xml| [r#"role="scale""#, r#"role="offset""#].iter().any(|r| xml.contains(r)))
        {
            let found = "values with a scale or an offset (gdal_translate -unscale -ot Float32 IN OUT applies it)";
            return Err(Fault::wrong("heights in metres", found));
        }
        let place = (keys.projection()?, keys.vertical()?);
        // Map coordinates of the first pixel's corner, or of its centre where pixels are points.
        let (origin, across, down) = match (transformation.as_deref(), scale.as_deref(), tie.as_deref()) {
            (_, Some(&[x, y, ..]), Some(&[i, j, _, east, north, ..])) => {
                ([east - i * x, north + j * y], [x, 0.0], [0.0, -y])
            }
            (Some(&[a, b, _, east, c, d, _, north, ..]), ..) => ([east, north], [a, c], [b, d]),
            _ => {
                let expected = "ModelPixelScale with ModelTiepoint, or ModelTransformation";
                return Err(Fault::wrong(expected, "a TIFF that does not say where it lies"));
            }
        };
        let inset = if keys.get(RASTER_TYPE) == Some(PIXEL_IS_POINT) {
            0.0
        } else {
            0.5
        };
        let first = [0, 1].map(|k| origin[k] + inset * (across[k] + down[k]));
        let georeference = Georeference::new(place, first, (across, down), size);
        Ok(Self {
            decoder,
            size,
            georeference: georeference.ok_or_else(|| Fault::wrong("pixels of finite size", "none"))?,
            void: void.transpose()?,
        })
    }
}

impl<R: Read + Seek> Raster for GeoTiff<R> {
    fn size(&self) -> [usize; 2] {
        self.size
    }

    fn georeference(&self) -> &Georeference {
        &self.georeference
    }

    /// Decodes the strips or tiles that the window touches, one at a time.
    fn read(&mut self, window: Window) -> Result<Vec<f32>, Fault> {
        let ([left, top], [width, rows]) = (window.first, window.size);
        let (right, bottom) = (left + width, top + rows);
        let (chunk_width, chunk_rows) = self.decoder.chunk_dimensions();
        let [chunk_width, chunk_rows] = [chunk_width as usize, chunk_rows as usize];
        if chunk_width == 0 || chunk_rows == 0 {
            return Err(Fault::wrong("strips or tiles", "some of no size"));
        }
        let chunks_across = self.size[0].div_ceil(chunk_width);
        let mut heights = vec![f32::NAN; width * rows];
        for chunk_y in top / chunk_rows..=(bottom - 1) / chunk_rows {
            for chunk_x in left / chunk_width..=(right - 1) / chunk_width {
                let index = u32::try_from(chunk_y * chunks_across + chunk_x)
                    .map_err(|_| Fault::wrong("fewer than 2³² tiles", "more"))?;
                let values = Values::of(self.decoder.read_chunk(index)?)?;
                let [x0, y0] = [chunk_x * chunk_width, chunk_y * chunk_rows];
                // Chunks at the right and lower edges come without their padding.
                let stride = chunk_width.min(self.size[0] - x0);
                for y in y0.max(top)..(y0 + chunk_rows).min(bottom) {
                    for x in x0.max(left)..(x0 + stride).min(right) {
                        if let Some(value) = values.get((y - y0) * stride + x - x0) {
                            heights[(y - top) * width + x - left] = height(value, self.void);
                        }
                    }
                }
            }
        }
        Ok(heights)
    }
}

/// The values of a strip or tile, as they are stored.
enum Values {
    I16(Vec<i16>),
    U16(Vec<u16>),
    I32(Vec<i32>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

impl Values {
    fn of(decoded: DecodingResult) -> Result<Self, Fault> {
        Ok(match decoded {
            DecodingResult::I16(values) => Self::I16(values),
            DecodingResult::U16(values) => Self::U16(values),
            DecodingResult::I32(values) => Self::I32(values),
            DecodingResult::F32(values) => Self::F32(values),
            DecodingResult::F64(values) => Self::F64(values),
            _ => {
                let expected = "values of int16, uint16, int32, float32 or float64";
                return Err(Fault::wrong(expected, "another type"));
            }
        })
    }

    fn get(&self, k: usize) -> Option<f64> {
        match self {
            Self::I16(values) => values.get(k).map(|v| (*v).into()),
            Self::U16(values) => values.get(k).map(|v| (*v).into()),
            Self::I32(values) => values.get(k).map(|v| (*v).into()),
            Self::F32(values) => values.get(k).map(|v| (*v).into()),
            Self::F64(values) => values.get(k).copied(),
        }
    }
}
