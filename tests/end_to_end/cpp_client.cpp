// Runs the C++ client for tests: reads commands from stdin and prints a line of JSON for each.
//
//     cpp_client ENDPOINT TIMEOUT_S MAX_IN_FLIGHT [KEY_FILE]
//
//     profile EYE WIDTH HEIGHT BODY   set a profile, and wait until it is ready
//     request EYE WIDTH HEIGHT BODY   set a profile without waiting
//     view WIDTH HEIGHT TYPE ENCODING FILE HIDDEN EYE PUPIL
//                                     add a view to the frame: color and depth are in FILE, then
//                                     hidden color and depth if HIDDEN is 1; PUPIL may be 0
//     clear PUPIL FOCUS OUTPUT        begin another frame
//     filter FILE                     filter the frame, and write its images to FILE
//     submit                          submit the frame
//     poll SECONDS                    the events
//     hello, ping, unanswered

#include <cstdio>
#include <fstream>
#include <iostream>
#include <sstream>

#include "ocufilter.hpp"

using namespace ocufilter;

namespace {

std::string quoted(const std::string& text) {
  std::string found = "\"";
  for (const unsigned char c : text) {
    char escaped[8];
    std::snprintf(escaped, sizeof escaped, "\\u%04x", c);
    found += c < 32 || c > 126 || c == '"' || c == '\\' ? escaped : std::string(1, c);
  }
  return found + '"';
}

std::string listed(const std::string& type, const Event& about, const std::string& what = "") {
  const auto id = [](auto n) { return n ? std::to_string(*n) : "null"; };
  return "[" + quoted(type) + ", " + id(about.frame_id) + ", " + id(about.profile_id) + ", " +
         quoted(what) + "]";
}

struct Words {
  std::string operator()(const Result& e) const { return listed("result", e); }
  std::string operator()(const Dropped& e) const { return listed("dropped", e, e.reason); }
  std::string operator()(const Error& e) const { return listed("error", e, e.code); }
  std::string operator()(const Accepted& e) const { return listed("accepted", e); }
  std::string operator()(const Progress& e) const { return listed("progress", e, e.stage); }
  std::string operator()(const Ready& e) const { return listed("ready", e); }
};

template <class Type>
Type named(std::istream& words, const char* const (&names)[4]) {
  std::string name;
  words >> name;
  for (int i = 0; i < 4; ++i)
    if (name == names[i]) return static_cast<Type>(i);
  throw std::invalid_argument(name);
}

constexpr const char* TYPES[] = {"uint8", "float16", "float32", "-"};
constexpr const char* ENCODINGS[] = {"float32", "float16", "dpt16", "mm16"};

class Program {
 public:
  Program(const std::string& endpoint, const Options& options) : client_(endpoint, options) {}

  std::string run(const std::string& line) {
    std::istringstream words(line);
    std::string command;
    words >> command;
    if (command == "profile" || command == "request") {
      Profile profile{"", {Camera()}};
      int width_px, height_px;
      words >> profile.eye >> width_px >> height_px;
      std::getline(words >> std::ws, profile.body);
      profile.cameras = {Camera::from_fov(60.0, width_px, height_px)};
      if (command == "request") return std::to_string(client_.request_profile(profile));
      return std::to_string(client_.set_profile(profile, 20.0).generation);
    }
    if (command == "clear") {
      frame_ = Frame();
      files_.clear();
      words >> frame_.pupil_diameter_mm >> frame_.focus_dpt;
      frame_.output = named<ColorType>(words, TYPES);
      return "null";
    }
    if (command == "view") {
      add_view(words);
      return "null";
    }
    if (command == "filter") {
      std::string path;
      words >> path;
      const Result result = client_.filter(frame_, 20.0);
      std::ofstream file(path, std::ios::binary);
      for (const Image& image : result.images)
        file.write(reinterpret_cast<const char*>(image.data()), std::streamsize(image.size_bytes()));
      return listed("result", result, result.images.at(0).eye);
    }
    if (command == "submit") return std::to_string(client_.submit(frame_));
    if (command == "poll") {
      double timeout_s;
      words >> timeout_s;
      std::string found;
      for (const AnyEvent& event : client_.poll(timeout_s))
        found += (found.empty() ? "" : ", ") + std::visit(Words(), event);
      return "[" + found + "]";
    }
    if (command == "hello") return std::to_string(client_.hello().session_id);
    if (command == "ping") return std::to_string(client_.ping().n_sessions);
    if (command == "unanswered") return std::to_string(client_.n_unanswered());
    throw std::invalid_argument(command);
  }

 private:
  void add_view(std::istream& words) {
    View view;
    int width_px, height_px, has_hidden;
    double pupil_diameter_mm;
    std::string path;
    words >> width_px >> height_px;
    view.camera = Camera::from_fov(60.0, width_px, height_px);
    view.color_type = named<ColorType>(words, TYPES);
    view.depth_encoding = named<DepthEncoding>(words, ENCODINGS);
    words >> path >> has_hidden >> view.eye >> pupil_diameter_mm;
    if (pupil_diameter_mm > 0.0) view.pupil_diameter_mm = pupil_diameter_mm;
    std::ifstream file(path, std::ios::binary);
    files_.emplace_back(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
    const std::size_t n_layers = has_hidden ? 2 : 1;
    const std::size_t n_pixels = std::size_t(width_px) * height_px;
    const std::size_t depth_bytes = n_pixels * (view.depth_encoding == DepthEncoding::float32 ? 4 : 2);
    const std::size_t color_bytes = files_.back().size() / n_layers - depth_bytes;
    const char* data = files_.back().data();
    view.color = {data, color_bytes};
    view.depth = {data + color_bytes, depth_bytes};
    if (has_hidden) {
      view.hidden_color = {data + color_bytes + depth_bytes, color_bytes};
      view.hidden_depth = {data + 2 * color_bytes + depth_bytes, depth_bytes};
    }
    frame_.views.push_back(view);
  }

  Client client_;
  Frame frame_;
  std::deque<std::vector<char>> files_;
};

}  // namespace

int main(int argc, char** argv) {
  Options options;
  options.timeout_s = std::stod(argv[2]);
  options.max_in_flight = std::stoi(argv[3]);
  if (argc > 4) options.key = Key::load(argv[4]);
  Program program(argv[1], options);
  for (std::string line; std::getline(std::cin, line);) {
    try {
      std::cout << program.run(line) << std::endl;
    } catch (const FilterError& error) {
      std::cout << "{\"code\": " << quoted(error.error.code) << ", \"field\": "
                << quoted(error.error.field) << ", \"message\": " << quoted(error.what()) << "}"
                << std::endl;
    } catch (const std::invalid_argument& error) {
      std::cout << "{\"code\": \"invalid_argument\", \"message\": " << quoted(error.what()) << "}"
                << std::endl;
    }
  }
}
