// Frames, profiles and replies of the client in ocufilter.hpp, and their form in messages.

#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <map>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include <msgpack.hpp>
#include <zmq.hpp>

namespace ocufilter {

// --- What a program sends ------------------------------------------------------------------

enum class ColorType { uint8, float16, float32 };  // 8-bit sRGB, or linear light
enum class DepthEncoding { float32, float16, dpt16, mm16 };

using Pair = std::array<double, 2>;
using Pose = std::array<double, 7>;  // position in meters, then a quaternion x, y, z, w
using Value = std::variant<bool, std::int64_t, double, std::string, std::vector<double>>;
using Values = std::map<std::string, Value>;

struct Camera {
  int width_px = 0;
  int height_px = 0;
  std::array<double, 4> tangents{};  // of the angles to the left, right, upper and lower edge

  static Camera from_fov(double vertical_fov_deg, int width_px, int height_px) {
    const double up = std::tan(vertical_fov_deg * (3.14159265358979323846 / 180.0) / 2.0);
    const double right = up * width_px / height_px;
    return {width_px, height_px, {-right, right, up, -up}};
  }
};

// Memory of the program, which `submit` copies.
struct Bytes {
  const void* data = nullptr;
  std::size_t size_bytes = 0;

  Bytes() = default;
  Bytes(const void* data, std::size_t size_bytes) : data(data), size_bytes(size_bytes) {}
  template <class T>
  Bytes(const std::vector<T>& values) : Bytes(values.data(), values.size() * sizeof(T)) {}
};

// Color [row][column][RGB] and depth [row][column], top row first, without padding.
struct View {
  Camera camera;
  Bytes color;
  Bytes depth;  // in meters along the camera's axis, unless the next fields say otherwise
  ColorType color_type = ColorType::uint8;
  DepthEncoding depth_encoding = DepthEncoding::float32;
  bool is_radial = false;   // depth is the distance from the camera
  Bytes hidden_color = {};  // optional: the image without the foremost surface
  Bytes hidden_depth = {};
  std::string eye = "both";                      // or "left" or "right"
  std::optional<double> pupil_diameter_mm = {};  // of this eye; by default the frame's
  std::optional<double> focus_dpt = {};
  std::optional<Pair> gaze_deg = {};
  std::optional<Pose> pose = {};  // the result repeats it
};

struct Frame {
  std::vector<View> views;  // two for stereo
  double pupil_diameter_mm = 4.0;
  double focus_dpt = 0.0;
  std::optional<Pair> gaze_deg = {};
  ColorType output = ColorType::uint8;
  std::optional<std::int64_t> display_time_ns = {};  // the result repeats it
  Values options = {};                               // names and values as in PROTOCOL.md
};

struct Profile {
  std::string body;                  // JSON, such as {"kind": "prescription", "sphere_dpt": -2}
  std::vector<Camera> cameras = {};  // to prepare for
  Values settings = {};              // names and values as in PROTOCOL.md
  std::string eye = "both";          // or "left" or "right"
};

// Keys in Z85, for a service that requires them.
struct Key {
  std::string server_public, client_public, client_secret;

  // Read a file that `ocufilter keys add NAME` has written.
  static Key load(const std::string& path) {
    std::string text(4096, '\0');  // a key file has 300 bytes
    std::ifstream file(path);
    file.read(text.data(), static_cast<std::streamsize>(text.size()));
    std::istringstream lines(text.substr(0, static_cast<std::size_t>(file.gcount())));
    std::map<std::string, std::string> found;
    for (std::string line; std::getline(lines, line);)
      if (const auto open = line.find(" = '"), close = line.rfind('\''); close > open + 3)
        found[line.substr(0, open)] = line.substr(open + 4, close - open - 4);
    for (const char* name : {"server", "public", "secret"})
      if (found[name].size() != 40)
        throw std::invalid_argument(path + ": '" + name + "' is missing or invalid; expected a " +
                                    "key file created with `ocufilter keys add NAME`");
    return {found["server"], found["public"], found["secret"]};
  }
};

struct Options {
  double timeout_s = 10.0;             // of a reply
  int max_in_flight = 1;               // unanswered frames; at most the service's credit
  std::string name = "ocufilter.hpp";  // appears in the service's log
  std::optional<Key> key = {};
  std::int64_t max_reply_bytes = 256'000'000;  // a larger part ends the connection
};

// --- What a program receives ---------------------------------------------------------------

struct Event {  // what it is about
  std::optional<std::int64_t> frame_id = {};
  std::optional<std::int64_t> profile_id = {};
};

struct Image {
  int width_px = 0;
  int height_px = 0;
  ColorType type = ColorType::uint8;
  std::string eye = "both";
  double pupil_diameter_mm = 0.0;  // as used, like the next two
  double focus_dpt = 0.0;
  Pair gaze_deg{};
  std::optional<Pose> pose = {};
  zmq::message_t part = {};

  // Bytes [row][column][RGB], which may not be aligned for floats: see `pixels`.
  const std::uint8_t* data() const { return part.data<std::uint8_t>(); }
  std::size_t size_bytes() const { return part.size(); }

  // Return a copy as std::uint8_t, std::uint16_t (half floats) or float.
  template <class T>
  std::vector<T> pixels() const {
    std::vector<T> values(part.size() / sizeof(T));
    if (values.size() != std::size_t{3} * width_px * height_px)
      throw std::invalid_argument("pixels: the size of T differs from that of a channel");
    std::memcpy(values.data(), part.data(), part.size());
    return values;
  }
};

struct Result : Event {
  std::vector<Image> images = {};  // one for each view
  std::int64_t generation = 0;     // of the profile
  std::int64_t missing_depth_count = 0;
  std::int64_t overflow_count = 0;  // the image lacks light unless this is 0
  std::optional<std::int64_t> display_time_ns = {};
  std::vector<std::string> notes = {};  // sentences for the user
  double total_ms = 0.0;                // from receiving the frame to sending the reply
};

struct Dropped : Event {
  std::string reason = {};  // as in PROTOCOL.md, or "connection_lost"
  double retry_after_ms = 20.0;
};

// The codes of the client itself are service_timeout, authentication_failed and bad_reply.
struct Error : Event {
  std::string code = {}, message = {}, field = {}, allowed = {};
};

struct Accepted : Event {
  std::int64_t generation = 0;
  bool is_building = false;
  int n_cameras = 0;  // the number of Ready to come
};

struct Progress : Event {
  std::string stage = {};
  double fraction = 0.0;
};

struct Ready : Event {
  std::int64_t generation = 0;
  std::vector<std::string> notes = {};
};

struct Welcome {
  std::int64_t session_id = 0;
  std::string renderer = {};
  std::int64_t max_part_bytes = 100'000'000;
  int credit = 1;
  bool is_resumed = false;
};

struct Pong {
  std::int64_t n_sessions = 0;
  bool is_ready = false;
  bool is_degraded = false;
};

using AnyEvent = std::variant<Result, Dropped, Error, Accepted, Progress, Ready>;

class FilterError : public std::runtime_error {
 public:
  explicit FilterError(const Error& error)
      : std::runtime_error((error.field.empty() ? "" : error.field + ": ") + error.message +
                           (error.allowed.empty() ? "" : " (allowed: " + error.allowed + ")")),
        error(error) {}
  const Error error;
};

// --- Messages ------------------------------------------------------------------------------

namespace detail {

using Message = std::vector<zmq::message_t>;

constexpr std::size_t MAX_PARTS = 16;  // of a reply
constexpr std::size_t MAX_HEADER_BYTES = 4096;
constexpr const char* COLOR_TYPES[] = {"uint8", "float16", "float32"};
constexpr const char* ENCODINGS[] = {"float32", "float16", "dpt16", "mm16"};

inline std::size_t bytes_of(ColorType type) { return std::size_t{1} << static_cast<int>(type); }
inline std::size_t bytes_of(DepthEncoding e) { return e == DepthEncoding::float32 ? 4 : 2; }

inline FilterError failure(const char* code, const std::string& message) {
  return FilterError(Error{{}, code, message, {}, {}});
}

// A msgpack map that is written entry by entry.
class MapWriter {
 public:
  MapWriter() = default;
  explicit MapWriter(const char* type) { add("type", type).add("version", 1); }
  MapWriter(const Values& values) {
    for (const auto& [name, value] : values)
      std::visit([this, &name = name](const auto& one) { add(name, one); }, value);
  }
  MapWriter(const Camera& camera) {
    add("width_px", camera.width_px).add("height_px", camera.height_px);
    add("tangents", camera.tangents);
  }
  MapWriter(ColorType type) {
    add("dtype", COLOR_TYPES[static_cast<int>(type)]);
    add("space", type == ColorType::uint8 ? "srgb" : "linear");
  }
  MapWriter(const View& view) : MapWriter(view.camera) {
    MapWriter depth;
    depth.add("kind", view.is_radial ? "radial" : "planar");
    depth.add("encoding", ENCODINGS[static_cast<int>(view.depth_encoding)]);
    add("color", MapWriter(view.color_type)).add("depth", depth);
    add("has_hidden", view.hidden_color.data != nullptr).add("eye", view.eye);
    add("pupil_diameter_mm", view.pupil_diameter_mm).add("focus_dpt", view.focus_dpt);
    add("gaze_deg", view.gaze_deg).add("pose", view.pose);
  }

  template <class T>
  MapWriter& add(const std::string& name, const T& value) {
    msgpack::pack(body_, name);
    msgpack::pack(body_, value);
    ++n_entries_;
    return *this;
  }
  template <class T>
  MapWriter& add(const std::string& name, const std::optional<T>& value) {
    return value ? add(name, *value) : *this;
  }

  template <class Packer>
  void msgpack_pack(Packer& packer) const {  // msgpack-cxx calls it, also for vectors of maps
    packer.pack_map(n_entries_);
    packer.pack_str_body(body_.data(), static_cast<std::uint32_t>(body_.size()));
  }

  std::string bytes() const {
    msgpack::sbuffer buffer;
    msgpack::pack(buffer, *this);
    return {buffer.data(), buffer.size()};
  }

 private:
  msgpack::sbuffer body_;
  std::uint32_t n_entries_ = 0;
};

// A map of a reply, whose fields are checked as they are read.
class Fields {
 public:
  explicit Fields(const msgpack::object& object) {
    if (object.type != msgpack::type::MAP) throw failure("bad_reply", "a reply is not a map");
    map_ = object.via.map;
  }

  template <class T>
  std::optional<T> find(const std::string& name) const {
    for (std::uint32_t i = 0; i < map_.size; ++i) {
      const auto& [key, value] = map_.ptr[i];
      if (key.type != msgpack::type::STR || value.is_nil()) continue;
      if (name.compare(0, name.npos, key.via.str.ptr, key.via.str.size) != 0) continue;
      try {
        return value.template as<T>();
      } catch (const msgpack::type_error&) {
        throw failure("bad_reply", "field '" + name + "' of a reply has a wrong type");
      }
    }
    return {};
  }

  template <class T>
  T get(const std::string& name) const {
    if (auto found = find<T>(name)) return std::move(*found);
    throw failure("bad_reply", "a reply lacks its field '" + name + "'");
  }
  template <class T>
  T get(const std::string& name, T fallback) const {
    return find<T>(name).value_or(std::move(fallback));
  }

  template <std::size_t N>
  std::optional<std::array<double, N>> numbers(const std::string& name) const {
    const auto found = find<std::vector<double>>(name);
    if (!found) return {};
    std::array<double, N> values;
    if (found->size() != N) throw failure("bad_reply", "'" + name + "' has a wrong length");
    std::copy(found->begin(), found->end(), values.begin());
    return values;
  }

 private:
  msgpack::object_map map_{};
};

inline Image image_of(const Fields& view, zmq::message_t part) {
  Image image{view.get<int>("width_px"), view.get<int>("height_px")};
  const auto dtype = Fields(view.get<msgpack::object>("color")).get<std::string>("dtype");
  const auto found = std::find(std::begin(COLOR_TYPES), std::end(COLOR_TYPES), dtype);
  if (found == std::end(COLOR_TYPES)) throw failure("bad_reply", "unknown type " + dtype);
  image.type = static_cast<ColorType>(found - COLOR_TYPES);
  const double expected = 3.0 * image.width_px * image.height_px * bytes_of(image.type);
  if (image.width_px < 1 || image.height_px < 1 || expected != static_cast<double>(part.size()))
    throw failure("bad_reply", "an image of " + std::to_string(image.width_px) + "x" +
                                   std::to_string(image.height_px) + " pixels has " +
                                   std::to_string(part.size()) + " bytes");
  image.eye = view.get<std::string>("eye", "both");
  image.pupil_diameter_mm = view.get("pupil_diameter_mm", 0.0);
  image.focus_dpt = view.get("focus_dpt", 0.0);
  image.gaze_deg = view.numbers<2>("gaze_deg").value_or(Pair{});
  image.pose = view.numbers<7>("pose");
  image.part = std::move(part);
  return image;
}

inline Result result_of(const Fields& reply, const Event& about, std::size_t n_views,
                        Message parts) {
  const auto views = reply.get<std::vector<msgpack::object>>("views");
  if (views.size() != n_views || parts.size() != n_views + 1)
    throw failure("bad_reply", "the result of " + std::to_string(n_views) + " views has " +
                                   std::to_string(parts.size() - 1) + " images");
  Result result{about};
  for (std::size_t i = 0; i < views.size(); ++i)
    result.images.push_back(image_of(Fields(views[i]), std::move(parts[i + 1])));
  result.generation = reply.get<std::int64_t>("generation", 0);
  result.missing_depth_count = reply.get<std::int64_t>("missing_depth_count", 0);
  result.overflow_count = reply.get<std::int64_t>("overflow_count", 0);
  result.display_time_ns = reply.find<std::int64_t>("display_time_ns");
  result.notes = reply.get<std::vector<std::string>>("notes", {});
  result.total_ms = reply.get("total_ms", 0.0);
  return result;
}

}  // namespace detail

}  // namespace ocufilter
