// A depth sensor that exists only in software, as a driver of the real OpenNI2 runtime.
//
// Everything above it is the real thing: device list, hot-plug events, streams, recorder. It is
// told what to do by a text file of `key=value` lines (environment: VIRTUAL_SENSOR_CONTROL),
// which is read again every few milliseconds; __init__.py lists the keys.

#include <atomic>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fcntl.h>
#include <fstream>
#include <map>
#include <mutex>
#include <string>
#include <sys/file.h>
#include <thread>
#include <unistd.h>
#include <vector>

#define XN_NEW(type, argument) new type(argument)
#define XN_DELETE(pointer) delete (pointer)
#include "Driver/OniDriverAPI.h"

using Clock = std::chrono::steady_clock;
using Milliseconds = std::chrono::milliseconds;

namespace {

constexpr int kMaxDevices = 3;
constexpr int kMaxDepthMm = 10000;
constexpr double kFovX = 1.0008; // radians: 585 pixels of focal length at 640 columns
constexpr double kFovY = 0.7784;

class Control {
public:
    static Control& instance() {
        static Control control;
        return control;
    }

    void reload() {
        std::map<std::string, std::string> values;
        std::ifstream file(path());
        for (std::string line; std::getline(file, line);) {
            const auto equals = line.find('=');
            if (equals != std::string::npos) values[line.substr(0, equals)] = line.substr(equals + 1);
        }
        std::lock_guard<std::mutex> guard(mutex_);
        values_.swap(values);
    }

    std::string text(const std::string& key) {
        std::lock_guard<std::mutex> guard(mutex_);
        const auto found = values_.find(key);
        return found == values_.end() ? "" : found->second;
    }

    long number(const std::string& key, long otherwise) {
        const std::string value = text(key);
        return value.empty() ? otherwise : std::strtol(value.c_str(), nullptr, 10);
    }

    bool on(const std::string& key) { return number(key, 0) != 0; }

    static std::string path() {
        const char* path = std::getenv("VIRTUAL_SENSOR_CONTROL");
        return path ? path : "";
    }

private:
    std::mutex mutex_;
    std::map<std::string, std::string> values_;
};

Control& control() { return Control::instance(); }

[[noreturn]] void hang() {
    for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
}

template <typename T> OniStatus answer(const T& value, void* data, int* size) {
    if (*size < static_cast<int>(sizeof(T))) return ONI_STATUS_BAD_PARAMETER;
    std::memcpy(data, &value, sizeof(T));
    *size = sizeof(T);
    return ONI_STATUS_OK;
}

std::vector<OniVideoMode> offered_modes() {
    const int width = control().number("width", 640), height = control().number("height", 480);
    const auto unit = control().on("tenths") ? ONI_PIXEL_FORMAT_DEPTH_100_UM : ONI_PIXEL_FORMAT_DEPTH_1_MM;
    // As with many sensors, the mode that is on after opening is not the one that is wanted.
    return {{unit, width / 2, height / 2, 30}, {unit, width, height, 30}};
}

class DepthStream : public oni::driver::StreamBase {
public:
    explicit DepthStream(std::atomic<long>& count) : count_(count), mode_(offered_modes().front()), mirror_(TRUE) {}
    ~DepthStream() override { stop(); }

    OniStatus start() override {
        if (control().on("hang_start")) hang();
        if (control().on("refuse_start")) return ONI_STATUS_ERROR;
        load_frames();
        running_ = true;
        thread_ = std::thread([this] { run(); });
        return ONI_STATUS_OK;
    }

    void stop() override {
        if (control().on("hang_stop")) hang();
        running_ = false;
        if (thread_.joinable()) thread_.join();
    }

    int row_bytes() const { return mode_.resolutionX * 2 + int(control().number("pad", 0)); }
    int getRequiredFrameSize() override { return row_bytes() * mode_.resolutionY; }

    OniBool isPropertySupported(int id) override {
        return id == ONI_STREAM_PROPERTY_CROPPING || id == ONI_STREAM_PROPERTY_HORIZONTAL_FOV ||
               id == ONI_STREAM_PROPERTY_VERTICAL_FOV || id == ONI_STREAM_PROPERTY_VIDEO_MODE ||
               id == ONI_STREAM_PROPERTY_MAX_VALUE || id == ONI_STREAM_PROPERTY_MIN_VALUE ||
               id == ONI_STREAM_PROPERTY_STRIDE || id == ONI_STREAM_PROPERTY_MIRRORING;
    }

    OniStatus getProperty(int id, void* data, int* size) override {
        const bool fov = id == ONI_STREAM_PROPERTY_HORIZONTAL_FOV || id == ONI_STREAM_PROPERTY_VERTICAL_FOV;
        if (fov && control().on("no_fov")) return ONI_STATUS_NOT_SUPPORTED;
        const bool asked = id == ONI_STREAM_PROPERTY_CROPPING || id == ONI_STREAM_PROPERTY_MIRRORING;
        if (asked && control().on("unreadable")) return ONI_STATUS_ERROR;
        if (fov && control().on("degrees"))
            return answer(float(id == ONI_STREAM_PROPERTY_HORIZONTAL_FOV ? 57.34 : 44.6), data, size);
        if (fov && control().on("other_fov")) return answer(float(1.2), data, size);
        switch (id) {
        case ONI_STREAM_PROPERTY_CROPPING: return answer(OniCropping{}, data, size);
        case ONI_STREAM_PROPERTY_HORIZONTAL_FOV: return answer(float(kFovX), data, size);
        case ONI_STREAM_PROPERTY_VERTICAL_FOV: return answer(float(kFovY), data, size);
        case ONI_STREAM_PROPERTY_VIDEO_MODE: return answer(mode_, data, size);
        case ONI_STREAM_PROPERTY_MAX_VALUE: return answer(kMaxDepthMm, data, size);
        case ONI_STREAM_PROPERTY_MIN_VALUE: return answer(0, data, size);
        case ONI_STREAM_PROPERTY_STRIDE: return answer(mode_.resolutionX * 2, data, size);
        case ONI_STREAM_PROPERTY_MIRRORING: return answer(OniBool(mirror_), data, size);
        default: return ONI_STATUS_NOT_SUPPORTED;
        }
    }

    OniStatus setProperty(int id, const void* data, int size) override {
        if (id == ONI_STREAM_PROPERTY_MIRRORING && size >= int(sizeof(OniBool))) {
            mirror_ = *static_cast<const OniBool*>(data);
            return ONI_STATUS_OK;
        }
        if (id == ONI_STREAM_PROPERTY_CROPPING && size == int(sizeof(OniCropping)))
            return static_cast<const OniCropping*>(data)->enabled ? ONI_STATUS_NOT_SUPPORTED
                                                                  : ONI_STATUS_OK;
        if (id != ONI_STREAM_PROPERTY_VIDEO_MODE || size != int(sizeof(OniVideoMode)))
            return ONI_STATUS_NOT_SUPPORTED;
        const auto& wanted = *static_cast<const OniVideoMode*>(data);
        for (const auto& mode : offered_modes())
            if (std::memcmp(&mode, &wanted, sizeof mode) == 0) {
                mode_ = wanted;
                return ONI_STATUS_OK;
            }
        return ONI_STATUS_NOT_SUPPORTED;
    }

    void notifyAllProperties() override {
        raisePropertyChanged(ONI_STREAM_PROPERTY_VIDEO_MODE, &mode_, sizeof mode_);
    }

private:
    void load_frames() {
        std::ifstream file(control().text("frames"), std::ios::binary | std::ios::ate);
        frames_.resize(file ? size_t(file.tellg()) / 2 : 0);
        file.seekg(0);
        file.read(reinterpret_cast<char*>(frames_.data()), std::streamsize(frames_.size() * 2));
    }

    void run() {
        // A first image takes its time; the runtime drops what comes before start() has returned.
        auto due = Clock::now() + Milliseconds(control().number("first_ms", 50));
        long burst_left = 0;
        while (running_) {
            const long fps = control().number("fps", 30), burst = control().number("burst", 1);
            const long limit = control().number("limit", -1);
            if (control().on("crash")) raise(SIGSEGV);
            if (control().on("aborts") && !control().on("connected")) abort();
            if (!control().on("connected") || control().on("stall") ||
                (limit >= 0 && made_ >= limit)) {
                std::this_thread::sleep_for(Milliseconds(2));
                due = Clock::now();
                continue;
            }
            if (burst_left-- <= 0) {
                burst_left = burst - 1;
                while (running_ && Clock::now() < due) {
                    const auto left = due - Clock::now();
                    std::this_thread::sleep_for(std::min<Clock::duration>(left, Milliseconds(5)));
                }
                due = std::max(due + std::chrono::microseconds(1000000 * burst / fps),
                               Clock::now() - Milliseconds(100));
                if (!running_) break;
            }
            deliver();
        }
    }

    void deliver() {
        OniFrame* frame = getServices().acquireFrame();
        if (!frame) return;
        const bool odd = control().on("odd");
        const int width = mode_.resolutionX, rows = mode_.resolutionY / (odd ? 2 : 1);
        const size_t pixels = size_t(mode_.resolutionX) * mode_.resolutionY;
        const size_t count = frames_.size() / pixels;
        auto* out = static_cast<uint16_t*>(frame->data);
        const int stride = row_bytes();
        if (count == 0) {
            std::memset(out, 0, pixels * 2);
        } else {
            const uint16_t* in = frames_.data() + (made_ % count) * pixels;
            if (mirror_)
                for (int row = 0; row < mode_.resolutionY; ++row)
                    for (int column = 0; column < width; ++column)
                        out[row * width + column] = in[row * width + width - 1 - column];
            else
                std::memcpy(out, in, pixels * 2);
        }
        frame->sensorType = ONI_SENSOR_DEPTH;
        frame->frameIndex = int(++made_);
        count_ = made_;
        const uint64_t time_us = uint64_t(made_) * 1000000 / 30;
        switch (control().number("clock", 0)) {
        case 1: frame->timestamp = 0; break;
        case 2: frame->timestamp = time_us / 1000; break; // milliseconds
        case 3: frame->timestamp = ((time_us * 60 + 0xFFFFFFFFull - 60000000) & 0xFFFFFFFFull) / 60; break;
        case 4: frame->timestamp = made_ % 4 ? time_us : time_us - 50000; break; // out of order
        default: frame->timestamp = time_us;
        }
        if (stride != width * 2) // rows apart, the last first: they overlap
            for (int row = mode_.resolutionY - 1; row > 0; --row)
                std::memmove(reinterpret_cast<char*>(out) + size_t(row) * stride, out + size_t(row) * width, width * 2);
        frame->videoMode = mode_;
        frame->width = width;
        frame->height = rows;
        frame->stride = stride;
        frame->dataSize = control().on("empty") ? 0 : rows * frame->stride;
        frame->croppingEnabled = FALSE;
        frame->cropOriginX = frame->cropOriginY = 0;
        raiseNewFrame(frame);
        getServices().releaseFrame(frame);
    }

    std::atomic<long>& count_;
    OniVideoMode mode_;
    std::atomic<int> mirror_;
    std::atomic<bool> running_{false};
    std::thread thread_;
    std::vector<uint16_t> frames_;
    long made_ = 0;
};

std::vector<OniVideoMode> colour_modes() {
    const int width = control().number("colour_width", control().number("width", 640));
    const int height = control().number("colour_height", control().number("height", 480));
    const auto format = OniPixelFormat(control().number("colour_format", ONI_PIXEL_FORMAT_RGB888));
    return {{format, width / 2, height / 2, 30}, {format, width, height, 30}};
}

// Colour beside depth: its images are made in step with those of depth, on the same clock.
class ColourStream : public oni::driver::StreamBase {
public:
    explicit ColourStream(std::atomic<long>& count) : count_(count), mode_(colour_modes().front()) {}
    ~ColourStream() override { stop(); }

    OniStatus start() override {
        if (control().on("refuse_colour_start")) return ONI_STATUS_ERROR;
        std::ifstream file(control().text("colour"), std::ios::binary | std::ios::ate);
        frames_.resize(file ? size_t(file.tellg()) : 0);
        file.seekg(0);
        file.read(frames_.data(), std::streamsize(frames_.size()));
        running_ = true;
        thread_ = std::thread([this] { run(); });
        return ONI_STATUS_OK;
    }

    void stop() override {
        running_ = false;
        if (thread_.joinable()) thread_.join();
    }

    size_t row_bytes() const {
        const int kind = mode_.pixelFormat;
        return size_t(mode_.resolutionX) * (kind == ONI_PIXEL_FORMAT_RGB888 ? 3 : kind == ONI_PIXEL_FORMAT_GRAY8 ? 1 : 2);
    }
    int getRequiredFrameSize() override { return int(row_bytes()) * mode_.resolutionY; }

    OniBool isPropertySupported(int id) override {
        return id == ONI_STREAM_PROPERTY_HORIZONTAL_FOV || id == ONI_STREAM_PROPERTY_VERTICAL_FOV ||
               id == ONI_STREAM_PROPERTY_VIDEO_MODE || id == ONI_STREAM_PROPERTY_STRIDE ||
               id == ONI_STREAM_PROPERTY_CROPPING || id == ONI_STREAM_PROPERTY_MIRRORING;
    }

    OniStatus getProperty(int id, void* data, int* size) override {
        switch (id) {
        case ONI_STREAM_PROPERTY_CROPPING: return answer(OniCropping{}, data, size);
        case ONI_STREAM_PROPERTY_MIRRORING: return answer(OniBool(FALSE), data, size);
        case ONI_STREAM_PROPERTY_HORIZONTAL_FOV: return answer(float(kFovX), data, size);
        case ONI_STREAM_PROPERTY_VERTICAL_FOV: return answer(float(kFovY), data, size);
        case ONI_STREAM_PROPERTY_VIDEO_MODE: return answer(mode_, data, size);
        case ONI_STREAM_PROPERTY_STRIDE: return answer(int(row_bytes()), data, size);
        default: return ONI_STATUS_NOT_SUPPORTED;
        }
    }

    OniStatus setProperty(int id, const void* data, int size) override {
        if (id == ONI_STREAM_PROPERTY_CROPPING) return ONI_STATUS_OK;
        if (id != ONI_STREAM_PROPERTY_VIDEO_MODE || size != int(sizeof(OniVideoMode))) return ONI_STATUS_NOT_SUPPORTED;
        for (const auto& mode : colour_modes())
            if (std::memcmp(&mode, data, sizeof mode) == 0) {
                mode_ = mode;
                return ONI_STATUS_OK;
            }
        return ONI_STATUS_NOT_SUPPORTED;
    }

    void notifyAllProperties() override {
        raisePropertyChanged(ONI_STREAM_PROPERTY_VIDEO_MODE, &mode_, sizeof mode_);
    }

private:
    void run() {
        const auto first = Clock::now() + Milliseconds(control().number("colour_first_ms", 50));
        while (running_) {
            if (count_ == made_ || Clock::now() < first) {
                std::this_thread::sleep_for(Milliseconds(1));
                continue;
            }
            made_ = count_;
            if (!control().on("stall_colour")) deliver();
        }
    }

    void deliver() {
        OniFrame* frame = getServices().acquireFrame();
        if (!frame) return;
        const size_t size = row_bytes() * mode_.resolutionY, count = frames_.size() / size;
        if (count) std::memcpy(frame->data, frames_.data() + ((made_ - 1) % count) * size, size);
        const int rows = mode_.resolutionY / (control().on("odd_colour") ? 2 : 1);
        frame->sensorType = ONI_SENSOR_COLOR;
        frame->frameIndex = int(made_);
        frame->timestamp = uint64_t(made_) * 1000000 / 30 + control().number("colour_late_us", 0);
        frame->videoMode = mode_;
        frame->width = mode_.resolutionX;
        frame->height = rows;
        frame->stride = int(row_bytes());
        frame->dataSize = rows * frame->stride;
        frame->croppingEnabled = FALSE;
        frame->cropOriginX = frame->cropOriginY = 0;
        raiseNewFrame(frame);
        getServices().releaseFrame(frame);
    }

    std::atomic<long>& count_;
    OniVideoMode mode_;
    std::atomic<bool> running_{false};
    std::thread thread_;
    std::vector<char> frames_;
    long made_ = 0;
};

class Device : public oni::driver::DeviceBase {
public:
    Device(int lock, char number)
        : lock_(lock), number_(number), modes_(offered_modes()), colour_modes_(colour_modes()) {}
    ~Device() override { close(lock_); }

    OniBool isPropertySupported(int id) override {
        return (id == ONI_DEVICE_PROPERTY_SERIAL_NUMBER && !serial().empty()) ||
               (id == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION && control().on("registers"));
    }
    OniBool isImageRegistrationModeSupported(OniImageRegistrationMode mode) override {
        return mode == ONI_IMAGE_REGISTRATION_OFF || control().on("registers");
    }
    OniStatus setProperty(int id, const void* data, int size) override {
        if (id != ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION || size != int(sizeof(int))) return ONI_STATUS_NOT_SUPPORTED;
        registration_ = *static_cast<const int*>(data);
        return ONI_STATUS_OK;
    }
    OniStatus getProperty(int id, void* data, int* size) override {
        if (id == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION && control().on("registers"))
            return answer(registration_, data, size);
        if (!isPropertySupported(id) || *size <= int(serial().size())) return ONI_STATUS_NOT_SUPPORTED;
        std::memcpy(data, serial().c_str(), serial().size() + 1);
        *size = int(serial().size()) + 1;
        return ONI_STATUS_OK;
    }

    OniStatus getSensorInfoList(OniSensorInfo** sensors, int* count) override {
        info_[0] = {ONI_SENSOR_DEPTH, int(modes_.size()), modes_.data()};
        info_[1] = {ONI_SENSOR_COLOR, int(colour_modes_.size()), colour_modes_.data()};
        *sensors = info_;
        *count = control().text("colour").empty() ? 1 : 2;
        return ONI_STATUS_OK;
    }

    oni::driver::StreamBase* createStream(OniSensorType type) override {
        if (type == ONI_SENSOR_COLOR && !control().on("refuse_colour")) return new ColourStream(count_);
        if (type != ONI_SENSOR_DEPTH || control().on("refuse_stream")) return nullptr;
        return new DepthStream(count_);
    }
    void destroyStream(oni::driver::StreamBase* stream) override { delete stream; }

private:
    std::string serial() const { return control().text(std::string("serial") + number_); }

    int lock_;
    char number_;
    std::vector<OniVideoMode> modes_;
    std::vector<OniVideoMode> colour_modes_;
    OniSensorInfo info_[2] = {};
    int registration_ = ONI_IMAGE_REGISTRATION_OFF;
    std::atomic<long> count_{0}; // depth frames made
};

class VirtualDriver : public oni::driver::DriverBase {
public:
    explicit VirtualDriver(OniDriverServices* services) : DriverBase(services) {}

    OniStatus initialize(oni::driver::DeviceConnectedCallback connected,
                         oni::driver::DeviceDisconnectedCallback disconnected,
                         oni::driver::DeviceStateChangedCallback changed, void* cookie) override {
        DriverBase::initialize(connected, disconnected, changed, cookie);
        std::printf("virtual sensor: real drivers print here too\n");
        std::fflush(stdout);
        control().reload();
        for (int number = 0; number < kMaxDevices; ++number) {
            auto& info = infos_[number];
            const bool again = control().on("addresses") && number > 0; // of the same sensor
            std::snprintf(info.uri, sizeof info.uri, again ? "virtual://0?depth-size=%d" : "virtual://%d", number);
            std::snprintf(info.vendor, sizeof info.vendor, "selective-depth");
            std::snprintf(info.name, sizeof info.name, "virtual depth sensor");
        }
        announce();
        running_ = true;
        thread_ = std::thread([this] {
            while (running_) {
                control().reload();
                announce();
                std::this_thread::sleep_for(Milliseconds(5));
            }
        });
        return ONI_STATUS_OK;
    }

    oni::driver::DeviceBase* deviceOpen(const char* uri, const char*) override {
        if (control().on("hang_open")) hang();
        if (control().on("refuse_open")) {
            getServices().errorLoggerAppend("the virtual sensor was told to refuse");
            return nullptr;
        }
        // One process at a time, as with a sensor on the USB bus.
        const char number = uri[std::strlen("virtual://")];
        const std::string lock_path = Control::path() + ".lock" + number;
        const int lock = open(lock_path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600);
        if (lock < 0 || flock(lock, LOCK_EX | LOCK_NB) != 0) {
            getServices().errorLoggerAppend("device is busy");
            if (lock >= 0) close(lock);
            return nullptr;
        }
        return new Device(lock, number);
    }
    void deviceClose(oni::driver::DeviceBase* device) override { delete device; }

    void shutdown() override {
        running_ = false;
        if (thread_.joinable()) thread_.join();
    }

private:
    void announce() {
        const long present = control().on("connected") ? control().number("devices", 1) : 0;
        for (int number = 0; number < kMaxDevices; ++number) {
            const bool here = number < present;
            if (here && !known_[number]) deviceConnected(&infos_[number]);
            if (!here && known_[number]) deviceDisconnected(&infos_[number]);
            known_[number] = here;
        }
    }

    OniDeviceInfo infos_[kMaxDevices] = {};
    bool known_[kMaxDevices] = {};
    std::atomic<bool> running_{false};
    std::thread thread_;
};

} // namespace

ONI_EXPORT_DRIVER(VirtualDriver)
